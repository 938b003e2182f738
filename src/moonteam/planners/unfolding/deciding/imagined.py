"""A mission that unfolds, from now on in sampled futures, as problems of the macro world.

Legend: F futures, N robots, T targets, the open ones (and places to look from or wait at, as the
moment has them) and then the coming ones, padded.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from moonteam.grid.macro.draw import places
from moonteam.grid.macro.streets import Streets
from moonteam.grid.macro.types import FAR, MacroProblem
from moonteam.planners import macro
from moonteam.planners.seconds.base import MS, needs_of
from moonteam.planners.unfolding.deciding.pointing import problem_in
from moonteam.planners.unfolding.future import Future
from moonteam.planners.unfolding.state import distances
from moonteam.planners.unfolding.world import View


def imagined(view: View, futures: Sequence[Future], size: int) -> MacroProblem:
    """[F] the mission from now on in each of these futures, padded to `size` targets.

    NumPy arrays. A target that comes is known of when it comes, as in the mission; whose service
    is under way counts as solved.
    """
    known, state = problem_in(view), view.state
    open_ = np.flatnonzero(~view.moment.solved)
    count, coming, team = len(futures), view.coming, len(view.places)
    total = len(open_) + coming
    spots = np.zeros((count, size, 2))
    known_at = np.array([*(t.at for t in view.targets), *(look.at for look in view.looks)], float)
    spots[:, :len(open_)] = known_at.reshape(-1, 2)[open_]
    after = [one.coming for one in futures]
    spots[:, len(open_):total] = np.array([[t.at for t in ts] for ts in after],
                                          float).reshape(count, coming, 2)
    there = np.arange(size) < total
    speed = np.array([agent.speed for agent in view.agents])
    metric = state.problem.metric
    far = distances(spots, spots, metric)
    both = there[:, None] & there[None]
    now = view.now / MS
    need = np.zeros((count, size, known.need.shape[1]), np.int32)
    columns: dict[str, Any] = {"need": need}
    for name in ("either", "service", "appears", "lapses", "worth", "shown", "following", "looks"):
        values = np.asarray(getattr(known, name))
        column = np.full((count, size), FAR if name == "lapses" else 0, values.dtype)
        column[:, :len(open_)] = values[open_]
        columns[name] = column
    need[:, :len(open_)] = known.need[open_]
    under_way = int((view.moment.ends > 0).sum())
    for f, targets in enumerate(after):
        need[f, len(open_):total, :len(state.names)], columns["either"][f, len(open_):total] = (
            needs_of(targets, state.names))
        for k, target in enumerate(targets, len(open_)):
            columns["appears"][f, k] = columns["shown"][f, k] = max(target.appears - now, 0.0)
            columns["worth"][f, k] = target.worth
            if target.lapses is not None:
                columns["lapses"][f, k] = max(target.lapses - now, 0.0)
            columns["following"][f, k] = max(target.following - view.ended - under_way, 0)
    waits = np.zeros((count, size, size), bool)
    waits[:, :len(open_), :len(open_)] = known.after[np.ix_(open_, open_)]
    area = None if state.problem.expects is None else state.problem.expects.area
    middle, spread = np.zeros((count, size)), np.zeros((0, 2))
    if coming and area is not None:
        spread = places(np.array(area[:2]), np.array(area[2:]))
        middle = distances(spots, spread, metric).mean(-1) / speed.max() * there
    has = np.asarray(known.has)
    start = np.full((count, team, size), FAR, np.float32)
    home = np.zeros((count, team, size), np.float32)
    here = distances(view.places, spots, metric) / speed[:, None]
    start[:, :, :total] = here[:, :, :total]
    for i, agent in enumerate(view.agents):
        if agent.home is not None:
            way = distances(spots, np.array([agent.home], float), metric)[..., 0]
            home[:, i] = way / agent.speed * there
    columns |= {
        "start": start, "home": home, "after": waits, "middle": middle.astype(np.float32),
        "between": np.where(both, far[:, None] / speed[:, None, None], FAR).astype(np.float32),
        "target_mask": np.broadcast_to(there, (count, size)),
        "unit": np.array([macro.unit_of(a, has, b) for a, b in zip(start, need, strict=True)],
                         np.float32)}
    gone = [[FAR if t is None else t - now for t in one.lost] for one in futures]
    columns["lost"] = np.array(gone, np.float32)
    for name in ("home_now", "has", "free", "effort", "limit", "agent_mask", "middle_now",
                 "coming"):
        value = np.asarray(getattr(known, name))
        columns[name] = np.broadcast_to(value, (count, *value.shape))
    columns["coming"] = np.zeros(count, np.int32)
    columns["unseen"] = np.zeros((count, size), np.float32)
    if metric == "manhattan":
        same = {"here": view.places, "speed": speed, "spread": spread}
        drawn: dict[str, Any] = {name: np.broadcast_to(x, (count, *x.shape)).astype(np.float32)
                                 for name, x in same.items()}
        drawn["at"] = spots.astype(np.float32)
        columns["streets"] = Streets(**drawn)
    return MacroProblem(**columns)
