"""Trials of single robots: traverses, slopes, speed, and their films."""
