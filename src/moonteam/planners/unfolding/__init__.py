"""Missions that unfold: a world that keeps what nobody knows yet, and who decides in it."""
