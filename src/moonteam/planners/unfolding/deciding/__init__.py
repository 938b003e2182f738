"""Who decides in a mission that unfolds: plans made anew, policies, and both over futures."""
