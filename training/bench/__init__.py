"""The learner measured, alone and beside a peer."""
