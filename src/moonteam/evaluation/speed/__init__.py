"""How fast planners and environments are."""
