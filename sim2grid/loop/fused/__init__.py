"""Whole missions as one program on MJX: who decides, decisions, looks, the loop, the record."""
