"""Guides of local search, learned by an evolution strategy."""
