"""Multi-agent PPO: tasks, rollout, advantage estimation, losses, update."""
