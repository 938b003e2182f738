"""Missions that unfold: a world that keeps what nobody knows yet; `deciding` in it is apart."""
