"""The loop: planner, waypoints, physics, positions back to the grid."""
