"""What people look at: film, map, page, plots, live view."""
