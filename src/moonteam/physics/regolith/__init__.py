"""Ground that gives way: the forces of loose soil on wheels and feet."""
