"""Learning from the exact planner, and refining what was learned."""
