"""A run: whatever is trained, in a folder, stopped and gone on with at any moment."""
