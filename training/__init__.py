"""Learning: configuration, rollout, GAE, losses, imitation, the loop."""
