"""The bridge: grid plans driven through physics, and physics mapped back to the grid."""
