"""Missions by the clock: a decision is a target, held until something happens; time is seconds."""
