"""A run: its configuration, loop, checkpoints, record."""
