"""What an exported policy is fed with, in NumPy alone: no JAX, nothing else of moonteam.

    session = onnxruntime.InferenceSession("any_team_imitated.onnx")
    seen = inputs(size=(32, 32), cells=cells, skills=skills, target_cells=spots,
                  target_skills=needs, target_and=both, solved=solved, steps_left=100)
    log_probs, pointer = session.run(None, seen)
    actions = choose(log_probs, seen["allowed"])

This file can be copied beside the exported one. Legend: N robots, M targets, K kinds of
robots, W columns (x), H rows (y); cells are (x, y), skills are bitmasks (A = 1, B = 2, C = 4).
Actions: 0 up (+y), 1 down (-y), 2 left (-x), 3 right (+x), 4 stay.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

UNREACHABLE = 1 << 20
_MOVES = np.array([(0, 1), (0, -1), (-1, 0), (1, 0)], np.int32)


def steps_from(passable: np.ndarray, goal: tuple[int, int]) -> np.ndarray:
    """[H, W] moves from every cell to the goal (x, y) by breadth-first search.

    A cell that is not passable gets its distance (a robot may stand there and leave) but leads
    nowhere; `UNREACHABLE` where there is no way.
    """
    height, width = passable.shape
    field = np.full((height, width), UNREACHABLE, np.int64)
    field[goal[1], goal[0]] = 0
    queue = deque([goal] if passable[goal[1], goal[0]] else [])
    while queue:
        x, y = queue.popleft()
        for dx, dy in _MOVES.tolist():
            u, v = x + dx, y + dy
            if 0 <= u < width and 0 <= v < height and field[v, u] == UNREACHABLE:
                field[v, u] = field[y, x] + 1
                if passable[v, u]:
                    queue.append((u, v))
    return field


def inputs(size: tuple[int, int], cells: Any, skills: Any, target_cells: Any, target_skills: Any,
           target_and: Any, solved: Any, steps_left: float, preference: float = 0.0,
           in_team: Any = None, passable: Any = None, kinds: Any = None) -> dict[str, np.ndarray]:
    """The exported network's inputs for one moment, with a batch axis of 1.

    Args:
      size: (W, H) cells.
      cells: [N, 2] of the robots.
      skills: [N] bitmask.
      target_cells: [M, 2].
      target_skills: [M] bitmask.
      target_and: [M] bool, all skills are needed together; False: one of them will do.
      solved: [M] bool.
      steps_left: until the mission must be over.
      preference: 0 time .. 1 effort.
      in_team: [N] bool, False for a lost robot; None: all are there.
      passable: [K, H, W] bool, cells that each kind may enter; None: open ground.
      kinds: [N] of each robot, index into `passable`.
    """
    cells, spots = np.asarray(cells, np.int32), np.asarray(target_cells, np.int32)
    width, height = size
    number = np.zeros(len(cells), int) if kinds is None else np.asarray(kinds)
    free = np.ones((1, height, width), bool) if passable is None else np.asarray(passable)
    if passable is None:  # no search is needed
        across = np.abs(np.arange(width)[None, :] - spots[:, :1])  # [M, W]
        along = np.abs(np.arange(height)[None, :] - spots[:, 1:])  # [M, H]
        fields = (along[:, :, None] + across[:, None, :])[None]  # [K, M, H, W]
    else:
        fields = np.array([[steps_from(ground, (int(x), int(y))) for x, y in spots]
                           for ground in free])
    team = np.ones(len(cells), bool) if in_team is None else np.asarray(in_team, bool)
    travel = fields[number, :, cells[:, 1], cells[:, 0]]  # [N, M]
    allowed = np.zeros((len(cells), 4), bool)
    toward = np.zeros((*travel.shape, 4), bool)
    for action, move in enumerate(_MOVES):
        goal = cells + move
        inside = np.clip(goal, 0, [width - 1, height - 1])
        enters = (goal == inside).all(1) & free[number, inside[:, 1], inside[:, 0]]
        nearer = fields[number, :, inside[:, 1], inside[:, 0]] == travel - 1
        allowed[:, action] = enters & team
        toward[:, :, action] = nearer & enters[:, None] & (travel < UNREACHABLE)
    found = {
        "agent_cells": cells, "agent_skills": np.asarray(skills, np.int32), "agent_mask": team,
        "target_cells": spots, "target_skills": np.asarray(target_skills, np.int32),
        "target_and": np.asarray(target_and, bool), "target_open": ~np.asarray(solved, bool),
        "travel": travel.astype(np.float32),
        "between": fields[:, :, spots[:, 1], spots[:, 0]].min(0).astype(np.float32),
        "toward": toward, "allowed": allowed, "time_left": np.float32(steps_left),
        "preference": np.float32(preference)}
    return {name: np.asarray(value)[None] for name, value in found.items()}


def choose(log_probs: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """[N] the likeliest action of each robot, of a batch of 1, that is not turned back."""
    stay = np.ones((*allowed.shape[:2], 1), bool)
    possible = np.concatenate([allowed, stay], axis=2)
    return np.where(possible, log_probs, -np.inf).argmax(2)[0]
