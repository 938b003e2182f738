"""Presets of `moonteam train` that imitate the exact planner; `refine` practises the same."""

from __future__ import annotations

from training.teacher.families import Family
from training.teacher.imitation import Imitation

PAPER = (Family(3, 5), Family(3, 6), Family(3, 7))

PRESETS = {
    "quick": Imitation(families=PAPER, rounds=900, num_envs=256, batches=2),
    "any_team": Imitation(
        families=(
            *PAPER,
            Family(2, 6, sides=(8, 32)),
            Family(3, 9, sides=(16, 48)),
            Family(4, 7, num_skills=3, sides=(16, 64), max_steps=256),
            Family(5, 9, num_skills=3, sides=(16, 40)),
            Family(6, 11, sides=(16, 40), exact_to=9, iterations=100),
            Family(3, 6, grounds=1024),
            Family(4, 7, num_skills=3, grounds=512),
            Family(5, 18, exact_to=7, iterations=100, shrink=4),
            Family(7, 30, num_skills=3, exact_to=7, iterations=100, shrink=8),
        ),
        rounds=1300, batches=2),
}
