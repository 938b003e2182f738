"""Families of missions that unfold, on 32 x 32 m, from which the test sets are drawn.

following: the paper's 5 + 5: each of the first five targets that is solved makes way for another;
one cell a second, along x and y. arrivals: three targets known from the start, five more by a
clock. hidden: five targets to be found by three robots of unlike speed that see 6 m. losses: teams
of four robots, three skills and eight targets, and in one mission of three a robot is lost.
scatter: eight targets known from the start, whose ways take more or less than expected. lapsing:
two targets known from the start, ten more by a clock, each worth something else, and each lapses.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from moonteam.grid.scenarios import generate
from moonteam.planners.seconds.base import Moment, moment
from moonteam.planners.unfolding.future import lapsing
from moonteam.problem import timed
from moonteam.problem.timed import Loss, Prospect, Timed

AREA = (0.0, 0.0, 31.0, 31.0)
EVERY_S, SENSOR_M = 10.0, 6.0
LOSS = Loss(share=1 / 3, until=40.0)
OFTEN_S, WORTH, STAYS = 8.0, (1.0, 5.0), (15.0, 40.0)
SCATTER = 0.084
"""Of ways of our own robots in physics, about the median of their kind and steepness: `moonteam
evaluate execution --site mare highland --count 100 --mode clock --planner exact`."""


@dataclass(frozen=True)
class Family:
    """How many of everything, and what is expected."""

    limit_s: float
    targets: int
    expects: Prospect
    agents: int = 3
    skills: int = 2


FAMILIES = {
    "following": Family(128.0, 10, Prospect(more=5, area=AREA)),
    "arrivals": Family(300.0, 8, Prospect(more=5, every=EVERY_S, area=AREA)),
    "hidden": Family(600.0, 5, Prospect(more=5, area=AREA)),
    "losses": Family(300.0, 8, Prospect(area=AREA, loss=LOSS), agents=4, skills=3),
    "scatter": Family(300.0, 8, Prospect(scatter=SCATTER)),
    "lapsing": Family(300.0, 12, Prospect(more=10, every=OFTEN_S, area=AREA, worth=WORTH,
                                          stays=STAYS))}


def draws(name: str, seed: int, speeds: tuple[float, ...]) -> Iterator[Timed]:
    """Endless missions of a family, not yet checked for time.

    Each robot draws one of the speeds, m/s, but in `following`.
    """
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    while True:
        yield _draw(name, rng, speeds)


def _draw(name: str, rng: np.random.Generator, speeds: tuple[float, ...]) -> Timed:
    family = FAMILIES[name]
    known = timed.of(generate(rng, num_agents=family.agents, num_targets=family.targets,
                              num_skills=family.skills))
    targets, agents = list(known.targets), list(known.agents)
    first = family.targets - family.expects.more
    change = msgspec.structs.replace
    if name != "following":
        agents = [change(agent, speed=float(rng.choice(speeds))) for agent in agents]
    if name == "following":
        targets[first:] = [change(t, following=k) for k, t in enumerate(targets[first:], 1)]
    elif name == "arrivals":
        times = np.cumsum(rng.exponential(EVERY_S, family.expects.more)).round(3).tolist()
        targets[first:] = [change(t, appears=s)
                           for t, s in zip(targets[first:], times, strict=True)]
    elif name == "lapsing":
        gaps = rng.exponential(OFTEN_S, family.expects.more)
        times = [*[0.0] * first, *np.cumsum(gaps).round(3).tolist()]
        targets = [change(t, appears=s, **lapsing(family.expects, s, rng))
                   for t, s in zip(targets, times, strict=True)]
    elif name == "hidden":
        targets = [change(t, hidden=True) for t in targets]
        agents = [change(agent, sensor=SENSOR_M) for agent in agents]
    elif name == "scatter":
        agents = [change(agent, pace=tuple(np.exp(
            SCATTER * rng.standard_normal(len(targets))).round(4).tolist())) for agent in agents]
    elif rng.random() < LOSS.share:
        i = int(rng.integers(len(agents)))
        agents[i] = change(agents[i], lost=round(float(rng.uniform(0, LOSS.until)), 3))
    return change(known, metric="manhattan" if name == "following" else "straight",
                  max_seconds=family.limit_s, agents=tuple(agents), targets=tuple(targets),
                  expects=family.expects)


def in_hindsight(problem: Timed) -> Moment:
    """The first moment with what every way will take; each agent is a travel class of its own."""
    now = moment(problem)
    pace = np.array([agent.pace or (1.0,) * len(problem.targets) for agent in problem.agents])
    return replace(
        now, start=np.rint(pace * now.start).astype(np.int64), classes=np.arange(len(pace)),
        between=np.rint(pace[:, None] * now.between[now.classes]).astype(np.int64))
