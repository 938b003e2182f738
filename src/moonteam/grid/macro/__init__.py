"""The world by the clock: one target a decision, held until something happens."""
