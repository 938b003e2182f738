"""Random problems of the macro world, for training; and the grid's problems by the clock.

Legend as in `types`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import Array

from moonteam import trees
from moonteam.grid.config import EnvConfig
from moonteam.grid.macro.apart import apart
from moonteam.grid.macro.sight import Sight, parts
from moonteam.grid.macro.streets import Streets
from moonteam.grid.macro.types import FAR, MacroProblem, plain
from moonteam.grid.sampling import sample
from moonteam.grid.types import Problem
from moonteam.problem.scenario import MAX_SKILLS
from moonteam.problem.timed import Metric


def bits(mask: Array, skills: int = MAX_SKILLS) -> Array:
    """[...] bit mask -> [..., S] bool."""
    shifts = jnp.arange(skills, dtype=mask.dtype).reshape(*[1] * mask.ndim, skills)
    return ((mask[..., None] >> shifts) & 1) == 1


def unit_of(start: Array, has: Array, need: Array, agent_mask: Array, target_mask: Array) -> Array:
    """[] s, the mean way to a target of agents that share a skill with it; 1 if there is none."""
    share = jnp.any(has[:, None] & (need[None] > 0), axis=2)
    use = share & agent_mask[:, None] & target_mask[None] & (start < FAR)
    mean = jnp.sum(jnp.where(use, start, 0.0)) / jnp.maximum(jnp.sum(use), 1)
    return jnp.where(mean > 0, mean, 1.0)


def of_grid(problem: Problem, cells: Array, limit: Array | float, metric: Metric = "manhattan",
            speed: Array | None = None, skills: int = MAX_SKILLS,
            start: Array | None = None, between: Array | None = None) -> MacroProblem:
    """A problem of the one-cell world by the clock: by default one cell a second.

    Args:
      problem: on an open map, if `start` and `between` are not given.
      cells: [N, 2] of the agents, whole or between two.
      limit: s.
      metric: of the ways.
      speed: [N] cells a second; 1 if not given.
      skills: S, at least as many as there are bits in use.
      start: [N, M] cells from each agent to each target, FAR where there is no way.
      between: [N, M, M] cells from target to target.
    """
    agents, targets = len(problem.agent_skills), len(problem.target_skills)
    pace = jnp.ones(agents) if speed is None else speed
    if start is None:
        start = apart(cells, problem.target_cells, metric)
    if between is None:
        flat = apart(problem.target_cells, problem.target_cells, metric)
        between = jnp.broadcast_to(flat[None], (agents, targets, targets))
    start = jnp.where(start < FAR, start / pace[:, None], FAR)
    between = jnp.where(between < FAR, between / pace[:, None, None], FAR)
    has = bits(problem.agent_skills, skills) & problem.agent_mask[:, None]
    need = (bits(problem.target_skills, skills) & problem.target_mask[:, None]).astype(jnp.int32)
    return plain(
        start, between, has, need, ~problem.target_and, limit=jnp.asarray(limit, jnp.float32),
        agent_mask=problem.agent_mask, target_mask=problem.target_mask,
        unit=unit_of(start, has, need, problem.agent_mask, problem.target_mask))


@dataclass(frozen=True)
class Draw:
    """A family of random problems of the macro world; hashable.

    Skills, coalitions and places are those of the grid's own sampling (`grid.sampling`), made
    harder by what is asked for here.
    """

    agents: tuple[int, int] = (3, 3)
    """Fewest and most robots."""
    targets: tuple[int, int] = (5, 7)
    """Fewest and most targets."""
    num_skills: int = 2
    """Skills that exist."""
    sides: tuple[int, int] = (32, 32)
    """Smallest and largest side of the square map, cells."""
    metric: Metric | Literal["either"] = "manhattan"
    """Of the ways; either: half of the problems each."""
    speeds: tuple[float, ...] = (1.0,)
    """Cells a second that a robot may have; each draws one."""
    unlike: float = 0.0
    """Share of problems in which every robot draws a speed of its own, from 0.2 to 1 and even in
    its logarithm, instead."""
    service: float = 0.0
    """Longest service, in usual ways; in half of the problems there is none."""
    numbers: int = 1
    """Most agents that a target of a single skill may need, in half of the problems."""
    homes: float = 0.0
    """Share of problems in which every robot has to be back where it started."""
    crews: tuple[int, int] = (0, 0)
    """Fewest and most kinds of robots, each with a skill of its own and one place where all of it
    start; a target asks for one robot each of some of the kinds. Services, and of a single kind
    up to `numbers` robots, are then asked for in all problems. 0: skills and places are every
    robot's own."""
    limit: float = 128.0
    """s in which everything must be done."""
    following: int = 0
    """Targets, the last of a problem: nobody knows of the first of them before one is solved, of
    the next before two are, and so on."""
    arriving: int = 0
    """Targets, the last of a problem, that nobody knows of before their time."""
    every: float = 10.0
    """Mean s between such times."""
    worth: tuple[float, float] = (0.0, 0.0)
    """Least and most that it counts to serve a target; 0: all have to be served."""
    stays: tuple[float, float] = (15.0, 40.0)
    """Fewest and most s until a target that is worth something lapses."""
    posts: bool = False
    """Whether there are places to wait at (`post_places`)."""
    looks: int = 0
    """Where every target is hidden: places from which robots look, so many along either side of the
    map, whose `sides` are then of one size, its ways straight."""
    sensor: float = 6.0
    """Cells that every robot sees around it."""

    @property
    def unfolds(self) -> bool:
        """Whether not everything is known from the start."""
        return bool(self.following or self.arriving or self.looks)

    @property
    def entries(self) -> int:
        """M, the most targets and all places to look from, or to wait at."""
        return self.targets[1] + self.looks**2 + (POSTS if self.posts else 0)

    @property
    def turns(self) -> int:
        """Decisions after which an episode should have ended."""
        # Those of a crew go together; what lapses is an event too.
        each = 4 if self.crews[1] > 1 else 3 if self.worth[1] else 2
        return each * (self.targets[1] + self.looks**2)

    @property
    def config(self) -> EnvConfig:
        """The grid's family with the largest team, most targets and largest map."""
        return EnvConfig(num_agents=self.agents[1], num_targets=self.targets[1],
                         width=self.sides[1], height=self.sides[1], num_skills=self.num_skills)


def draw(family: Draw, key: Array) -> MacroProblem:
    """One random problem."""
    many, team, size, pose, pace, ways, more = jax.random.split(key, 7)
    count = jax.random.randint(many, (), family.targets[0], family.targets[1] + 1)
    number = jax.random.randint(team, (), family.agents[0], family.agents[1] + 1)
    side = jax.random.randint(size, (), family.sides[0], family.sides[1] + 1)
    problem, cells = sample(family.config, pose, number, count, jnp.stack([side, side]))
    speed, skills = paces(family, pace), family.num_skills
    if family.crews[1]:
        problem, cells = in_crews(family, problem, cells, jax.random.fold_in(more, 2))
    if family.looks:
        problem, skills = looked_for(family, problem), skills + 1
    if family.posts:
        problem = with_entries(problem, post_places(jnp.zeros(2), problem.size - 1.0), 0)
    if family.metric == "either":
        made = [of_grid(problem, cells, family.limit, metric, speed, skills)
                for metric in ("manhattan", "straight")]
        straight = jax.random.bernoulli(ways)
        made = jax.tree.map(lambda a, b: jnp.where(straight, b, a), *made)
    else:
        made = of_grid(problem, cells, family.limit, family.metric, speed, skills)
    made = asking(family, made, more)
    if family.unfolds:
        made = unfolding(family, made, problem, cells, speed, jax.random.fold_in(more, 1))
    return trees.single(made)


def in_crews(family: Draw, problem: Problem, cells: Array, key: Array) -> tuple[Problem, Array]:
    """The problem with robots of few kinds that start together, and targets that ask for those."""
    some, need = jax.random.split(key)
    kinds = jax.random.randint(some, (), family.crews[0], family.crews[1] + 1)
    kinds = jnp.minimum(kinds, jnp.sum(problem.agent_mask))
    kind = jnp.arange(problem.agent_mask.shape[0]) % kinds
    asked = jax.random.randint(need, problem.target_mask.shape, 1, 2**kinds)
    return replace(
        problem, agent_skills=jnp.where(problem.agent_mask, 1 << kind, 0),
        target_skills=jnp.where(problem.target_mask, asked, 0),
        target_and=problem.target_mask), cells[kind]


def looked_for(family: Draw, problem: Problem) -> Problem:
    """The problem with the places to look from after its targets, and eyes as one more skill."""
    eyes = 1 << family.num_skills
    spots = places(jnp.zeros(2), problem.size - 1.0, family.looks)
    return replace(with_entries(problem, spots, eyes), agent_skills=problem.agent_skills | eyes)


def with_entries(problem: Problem, spots: Array, skills: int) -> Problem:
    """The problem with these places [P, 2] after its targets, which need all of `skills`."""
    join = lambda a, b: jnp.concatenate([a, jnp.broadcast_to(b, (len(spots), *a.shape[1:]))])
    return replace(
        problem, target_cells=jnp.concatenate([problem.target_cells.astype(jnp.float32), spots]),
        target_skills=join(problem.target_skills, jnp.int32(skills)),
        target_and=join(problem.target_and, jnp.array(True)),
        target_mask=join(problem.target_mask, jnp.array(True)))


def unfolding(family: Draw, made: MacroProblem, problem: Problem, cells: Array, speed: Array,
              key: Array) -> MacroProblem:
    """The problem, its last targets to follow on others or to arrive by a clock."""
    targets = made.start.shape[1]
    real = made.target_mask & (jnp.arange(targets) < family.targets[1])
    turn = jnp.arange(targets) - (jnp.sum(real) - max(family.following, family.arriving)) + 1
    late = real & (turn > 0)
    if family.posts:
        made = replace(made, looks=jnp.arange(targets) >= family.entries - POSTS)
    if family.looks:
        made = hidden(family, made, problem, cells, speed)
    elif family.following:
        made = replace(made, following=jnp.where(late, turn, 0).astype(jnp.int32))
    else:
        gaps = family.every * jax.random.exponential(key, (targets,))
        when = jnp.where(late, jnp.cumsum(jnp.where(late, gaps, 0.0)), 0.0)
        made = replace(made, appears=when, shown=when)
    if family.worth[1]:
        made = lapsing(family, made, real, jax.random.fold_in(key, 1))
    metric: Metric = "manhattan" if family.metric == "manhattan" else "straight"
    fastest = jnp.max(jnp.where(made.agent_mask, speed, 0.0))
    spots = places(jnp.zeros(2), problem.size - 1.0)
    if metric == "manhattan":
        made = replace(made, streets=Streets(
            at=problem.target_cells.astype(jnp.float32), here=cells.astype(jnp.float32),
            speed=jnp.where(made.agent_mask, speed, fastest), spread=spots))
    mean = lambda at: jnp.mean(apart(at, spots, metric), axis=1) / fastest
    return replace(made, middle=mean(problem.target_cells), middle_now=mean(cells))


def lapsing(family: Draw, made: MacroProblem, real: Array, key: Array) -> MacroProblem:
    """The problem, its `real` [M] targets worth something each, and lapsing after a while."""
    value, time = jax.random.split(key)
    targets = made.start.shape[1:]
    low, high = family.worth
    worth = jax.random.uniform(value, targets, minval=low, maxval=high)
    low, high = family.stays
    stays = jax.random.uniform(time, targets, minval=low, maxval=high)
    return replace(made, worth=jnp.where(real, worth, 0.0),
                   lapses=jnp.where(real, made.shown + stays, FAR))


def hidden(family: Draw, made: MacroProblem, problem: Problem, cells: Array,
           speed: Array) -> MacroProblem:
    """The problem, its targets to be seen on the way or from places to look from."""
    looks = jnp.arange(family.entries) >= family.targets[1]
    points, padding = parts(family.sides[1], family.looks)
    team = made.agent_mask
    first = family.targets[1]
    part = jnp.arange(family.entries)[None] == jnp.arange(first, first + len(points))[:, None]
    return replace(made, looks=looks, sight=Sight(
        at=problem.target_cells.astype(jnp.float32), hidden=made.target_mask & ~looks,
        speed=jnp.where(team, speed, 1.0), reach=jnp.where(team, family.sensor, 0.0),
        points=jnp.asarray(points), part=part, size=jnp.asarray((~padding).sum(1)),
        seen=jnp.asarray(padding),
        found=jnp.zeros(family.entries, bool), here=cells.astype(jnp.float32),
        aim=cells.astype(jnp.float32)))


def places(low: Any, high: Any, along: int = 8) -> Any:
    """[P, 2] of a rectangle, evenly: the middles of `along` times `along` parts.

    Of NumPy's arrays or JAX's, `low` and `high` [2].
    """
    xp = low.__array_namespace__()
    share = (xp.arange(along) + 0.5) / along
    grid = xp.stack(xp.meshgrid(share, share), axis=-1).reshape(-1, 2)
    return low[None] + grid * (high - low)[None]


POSTS = 5
"""Places to wait at: the middle of the area, and those of its quarters."""


def post_places(low: Any, high: Any) -> Any:
    """[`POSTS`, 2] of a rectangle; of NumPy's arrays or JAX's, `low` and `high` [2]."""
    xp = low.__array_namespace__()
    return xp.concat([places(low, high, 1), places(low, high, 2)])


def paces(family: Draw, key: Array) -> Array:
    """[N] cells a second."""
    listed, own, which = jax.random.split(key, 3)
    shape = (family.agents[1],)
    speeds = jnp.asarray(family.speeds)[jax.random.randint(listed, shape, 0, len(family.speeds))]
    if not family.unlike:
        return speeds
    unlike = jnp.exp(jax.random.uniform(own, shape, minval=jnp.log(0.2), maxval=0.0))
    return jnp.where(jax.random.bernoulli(which, family.unlike), unlike, speeds)


def asking(family: Draw, problem: MacroProblem, key: Array) -> MacroProblem:
    """The problem with services, coalitions by number and homes, as the family asks."""
    length, some, team, many, home = jax.random.split(key, 5)
    targets, always = problem.start.shape[1], family.crews[1] > 0
    if family.service:
        longest = family.service * problem.unit * (jax.random.bernoulli(some) | always)
        problem = replace(problem, service=longest * jax.random.uniform(length, (targets,)))
    if family.numbers > 1:
        able = problem.has & problem.agent_mask[:, None]
        have = jnp.sum(jnp.where(problem.need > 0, jnp.sum(able, axis=0)[None], 0), axis=1)  # [M]
        wanted = jax.random.randint(many, (targets,), 1, family.numbers + 1)
        team_wanted = jax.random.bernoulli(team) | always
        wanted = jnp.where(team_wanted, jnp.clip(wanted, 1, have), 1)
        single = jnp.sum(problem.need > 0, axis=1) == 1
        need = jnp.where(single[:, None], problem.need * wanted[:, None], problem.need)
        problem = replace(problem, need=need, either=problem.either & ~(single & (wanted > 1)))
    if family.homes:
        back = jax.random.bernoulli(home, family.homes)
        problem = replace(problem, home=jnp.where(back & (problem.start < FAR), problem.start, 0.0))
    return problem
