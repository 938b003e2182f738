"""Random moments of every combination of what a target, an agent and a mission may ask."""

import numpy as np

from moonteam.planners.seconds.base import NEVER, Moment, effort, makespan, problems

OBJECTIVES = ("makespan", "effort", "weighted")


def judged(now, plan):
    """The plan, if it is what it says."""
    assert problems(now, plan.services) == []
    assert (plan.makespan, plan.effort) == (makespan(now, plan.services),
                                            effort(now, plan.services))
    return plan


class Draw:
    """Numbers of one instance."""

    def __init__(self, seed):
        self.r = np.random.default_rng(seed)

    def on(self, chance):
        return bool(self.r.random() < chance)


def skills(d, n, m):
    """has [n, S], need [m, S], either [m]; somebody has everything."""
    r, count = d.r, int(d.r.integers(1, 4))
    has = r.random((n, count)) < 0.65
    has[r.integers(n)] = True
    need = np.zeros((m, count), np.int64)
    numbers = d.on(0.3)
    for j in range(m):
        need[j, r.permutation(count)[:r.integers(1, count + 1)]] = 1
        s = r.integers(count)
        if numbers and has[:, s].sum() > 1 and d.on(0.5):
            need[j, s] = 2
    either = (r.random(m) < 0.5) & (need.max(1) == 1) if d.on(0.5) else np.zeros(m, bool)
    return has, need, either


def ways(d, n, m):
    """start, between, home, home_now, classes: straight ways rounded, or any numbers at all."""
    r, kinds = d.r, int(d.r.integers(1, 3))
    classes = r.integers(kinds, size=n)
    if d.on(0.6):
        points = r.random((2 * n + m, 2)) * 20
        apart = np.linalg.norm(points[:, None] - points[None], axis=2)
        unit = 10 if d.on(0.3) else 1000  # coarse rounding breaks the triangle inequality
        way = np.stack([1 + np.rint(apart / v * unit) for v in r.choice([0.5, 1.0, 1.7], kinds)])
        at, home = np.arange(n), n + m + np.arange(n)
        targets = slice(n, n + m)
        return (way[classes, at, targets], way[:, targets, targets], way[classes, home, targets],
                way[classes, at, home], classes)
    high = int(r.choice([12, 1000]))
    start, between = r.integers(1, high, (n, m)), r.integers(1, high, (kinds, m, m))
    if d.on(0.3):
        start[r.random(start.shape) < 0.15] = NEVER
        between[r.random(between.shape) < 0.15] = NEVER
    return start, between, r.integers(1, high, (n, m)), r.integers(1, high, n), classes


def chains(d, m):
    """after [m, m] without circles."""
    after = np.zeros((m, m), bool)
    if m > 1 and d.on(0.4):
        order = d.r.permutation(m)
        for _ in range(d.r.integers(1, 3)):
            i, j = sorted(d.r.choice(m, 2, replace=False))
            after[order[j], order[i]] = True
    return after


def instance(seed, most=5):
    """A moment of up to three agents and `most` targets; every option is on or off by chance."""
    d = Draw(seed)
    r, on = d.r, d.on
    m = int(r.integers(1, most + 1))
    n = int(r.integers(1, 4 if m < 4 else 3))
    has, need, either = skills(d, n, m)
    start, between, home, home_now, classes = ways(d, n, m)
    known = start[start < NEVER]
    size = int(max(2, np.median(known))) if len(known) else 10
    homes = r.random(n) < 0.7 if on(0.5) else np.zeros(n, bool)
    appears = r.integers(0, 2 * size, m) * (r.random(m) < 0.5) if on(0.3) else np.zeros(m)
    lapses = np.full(m, NEVER)
    if on(0.3):
        lapses = np.where(r.random(m) < 0.5, appears + r.integers(size // 2, 5 * size, m), lapses)
    present, solved, ends = np.ones(n, bool), np.zeros(m, bool), np.zeros(m, np.int64)
    if n > 1 and on(0.2):
        present[r.integers(n)] = False
    if m > 1 and on(0.2):
        solved[j := r.integers(m)] = True
        ends[j] = r.integers(0, 2 * size)
    ints = [np.asarray(x, np.int64) for x in (
        start, between, home * homes[:, None], home_now * homes, classes)]
    return Moment(
        *ints, has=has, need=need, either=either,
        service=r.integers(0, size, m) if on(0.5) else np.zeros(m, np.int64),
        after=chains(d, m), appears=appears.astype(np.int64), lapses=lapses.astype(np.int64),
        free=r.integers(0, size, n) if on(0.3) else np.zeros(n, np.int64),
        present=present, solved=solved, ends=ends,
        effort=r.choice([1.0, 0.5, 2.5], n) if on(0.3) else np.ones(n),
        limit=int(size * r.uniform(2, 2 + m)) if on(0.2) else NEVER)


def large(seed, n, m, skills=1, most=4, span=1.0, speed=0.2, service=2.0):
    """Robots that all start and end at one depot; coalitions by number; straight ways."""
    r = np.random.default_rng(seed)
    points = r.random((m + 1, 2)) * span
    apart = np.rint(1000 * np.linalg.norm(points[:, None] - points[None], axis=2) / speed)
    apart = apart.astype(np.int64)
    has = np.zeros((n, skills), bool)
    has[np.arange(n), np.arange(n) % skills] = True
    need = np.zeros((m, skills), np.int64)
    need[np.arange(m), r.integers(skills, size=m)] = r.integers(1, most + 1, m)
    none = np.zeros(m, np.int64)
    return Moment(
        start=np.tile(apart[0, 1:], (n, 1)), between=apart[None, 1:, 1:],
        home=np.tile(apart[1:, 0], (n, 1)), home_now=np.zeros(n, np.int64),
        classes=np.zeros(n, np.int64), has=has, need=need, either=np.zeros(m, bool),
        service=np.rint(1000 * service * r.random(m)).astype(np.int64),
        after=np.zeros((m, m), bool), appears=none, lapses=np.full(m, NEVER),
        free=np.zeros(n, np.int64), present=np.ones(n, bool), solved=np.zeros(m, bool), ends=none,
        effort=np.ones(n))
