"""A planning problem by the clock, as a file: a JSON object with `"clock": "seconds"`.

What a scenario in steps says in cells and moves is said here in places and seconds: positions off
the lattice, a speed and a home for each agent; for each target a service time, a coalition by
skill and number, targets that come before it, a time at which it appears and one after which it
lapses. Everything but places and skills may be left out, and then is the paper's case.

A problem may unfold: targets that are hidden or arrive, robots that are lost, ways that take
longer than anybody knew. All that will happen stands in the file, so that whoever decides meets the
same future; nobody is told before it happens (`moonteam.planners.unfolding`), but a planner that is
given the whole problem at once plans in hindsight.

Seconds stand for the file's own unit of time, metres for its unit of length, where it comes from
others (`source` says so).
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable
from typing import Annotated, Any, Literal

import msgspec

from moonteam import files
from moonteam.errors import InputError
from moonteam.problem.scenario import (
    MAX_SKILLS,
    MOST_AGENTS,
    MOST_TARGETS,
    Name,
    Scenario,
    Skills,
)
from moonteam.strict import json_value

Place = tuple[float, float]
Metric = Literal["straight", "manhattan"]
Coalition = Annotated[dict[Name, int], msgspec.Meta(max_length=8 * MAX_SKILLS)]

MOST_SIDE = 1024
"""m of the area in which targets may be hidden."""

MOST_WORTH = 1e6
"""Of a target."""

NOT_SURE = "it comes after a target that has a worth, and so need not be served"
MOST_SECONDS = 1e9
"""Of a way, a service or a limit: planners count milliseconds, and a thousand of these add up."""


class Agent(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A robot: where it is, m; its speed, m/s; where it has to be at the end, if anywhere."""

    at: Place
    skills: Skills
    speed: float = 1.0
    home: Place | None = None
    kind: str | None = None
    sensor: float | None = None
    """m within which it sees hidden targets; None: it sees none."""
    lost: float | None = None
    """s at which it is lost, which nobody knows before."""
    pace: Annotated[tuple[float, ...], msgspec.Meta(max_length=MOST_TARGETS)] = ()
    """For each target, how many times what is expected its ways there take; unknown before."""


class Target(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A place that needs a coalition, all of it there from the service's start to its end.

    `skills` with `type` OR: one agent that has any of them. AND: agents that together have all.
    `coalition` says more than AND: at least so many agents that have each skill; an agent counts
    for every skill that it has.
    """

    at: Place
    skills: Skills = ()
    type: Literal["AND", "OR"] = "AND"
    coalition: Coalition = {}
    service: float = 0.0
    """s that the coalition stays."""
    after: Annotated[tuple[int, ...], msgspec.Meta(max_length=MOST_TARGETS)] = ()
    """Targets whose services have ended before this one's starts."""
    appears: float = 0.0
    """s before which no service starts; where a mission unfolds, nobody knows of it before."""
    lapses: float | None = None
    """s after which no service starts."""
    worth: float = 0.0
    """What it counts to serve it, of a target that may lapse; 0: the mission fails if it does."""
    hidden: bool = False
    """Nobody knows of it before an agent with a sensor has been near enough."""
    following: int = 0
    """Nobody knows of it, and it cannot be served, before so many others are solved."""

    def needs(self) -> dict[str, int]:
        """Agents needed of each skill; of an OR target one of each, any of which will do."""
        return self.coalition or dict.fromkeys(self.skills, 1)


class Known(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """What is known of the least makespan: proved, a bound, and what others found, by name.

    Where targets may lapse, it is that of plans which serve the most.
    """

    makespan: float | None = None
    bound: float | None = None
    worth: float | None = None
    """The most that can be served where targets may lapse."""
    published: dict[str, float] = {}


class Loss(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """In a share of missions one robot, any of them, is lost, at any time up to `until` s."""

    share: float
    until: float


class Prospect(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """What everybody may expect, from the start, of what nobody knows yet."""

    more: int = 0
    """Targets that are still to be known of."""
    every: float | None = None
    """Mean s between arrivals, by the clock; None where they follow on others or are hidden."""
    area: tuple[float, float, float, float] | None = None
    """West, south, east and north, m: where targets can be."""
    loss: Loss | None = None
    scatter: float = 0.0
    """Standard deviation of the logarithm of what ways take over what is expected."""
    worth: tuple[float, float] | None = None
    """Least and most that a target which arrives counts, even in between; None: all have to be
    served."""
    stays: tuple[float, float] | None = None
    """Fewest and most s from its arrival until it lapses, even in between; None: it does not."""


class Timed(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A problem by the clock.

    Its makespan is when the last service has ended and every agent with a home is there again.
    """

    clock: Literal["seconds"]
    agents: Annotated[tuple[Agent, ...], msgspec.Meta(max_length=MOST_AGENTS)]
    targets: Annotated[tuple[Target, ...], msgspec.Meta(max_length=MOST_TARGETS)]
    id: str = ""
    metric: Metric = "straight"
    max_seconds: float | None = None
    optimal: Known | None = None
    source: str = ""
    """Where it comes from, with its licence."""
    expects: Prospect | None = None
    """Where the mission unfolds."""

    @property
    def unfolds(self) -> bool:
        """Whether it says anything that only a mission which unfolds asks."""
        return any(a.lost is not None or a.pace or a.sensor for a in self.agents) or any(
            t.hidden or t.following for t in self.targets)

    @property
    def skill_names(self) -> tuple[str, ...]:
        """All skills that are had or needed, in sorted order."""
        return tuple(sorted({s for a in self.agents for s in a.skills}
                            | {s for t in self.targets for s in t.needs()}))


def of(scenario: Scenario) -> Timed:
    """The scenario by the clock: one cell a second, Manhattan ways. Closed cells are left out."""
    return Timed(
        clock="seconds", id=scenario.id, metric="manhattan",
        max_seconds=float(scenario.max_steps),
        agents=tuple(Agent((float(a.at[0]), float(a.at[1])), a.skills, kind=a.kind)
                     for a in scenario.agents),
        targets=tuple(Target((float(t.at[0]), float(t.at[1])), t.skills, t.type)
                      for t in scenario.targets))


def check(timed: Timed, source: object, where: str = "") -> Timed:
    """The rules that types cannot say. Raises InputError naming the key and what is allowed."""

    def fail(key: str, problem: str) -> InputError:
        return InputError(source, problem, f"{where}.{key}" if where else key)

    if not timed.agents:
        raise fail("agents", "at least one agent is needed")
    if not timed.targets:
        raise fail("targets", "at least one target is needed")
    if len(timed.skill_names) > 8 * MAX_SKILLS:
        raise fail("agents", f"{len(timed.skill_names)} different skills; at most "
                   f"{8 * MAX_SKILLS} are allowed")
    if timed.max_seconds is not None:
        check_limit(timed.max_seconds, lambda p: fail("max_seconds", p))
    team = headcount(agent.skills for agent in timed.agents)
    for i, agent in enumerate(timed.agents):
        _check_agent(agent, lambda key, problem, i=i: fail(f"agents[{i}].{key}", problem))
    for j, target in enumerate(timed.targets):
        say = lambda key, problem, j=j: fail(f"targets[{j}].{key}", problem)
        check_target(target, len(timed.targets), j, say)
        check_coalition(target, team, say)
    _check_ways(timed, fail)
    for j, target in enumerate(timed.targets):
        if any(timed.targets[k].worth for k in target.after):
            raise fail(f"targets[{j}].after", NOT_SURE)
    for j in after_itself([target.after for target in timed.targets]):
        raise fail(f"targets[{j}].after", "it would come before itself: a circle of targets that "
                   "wait for each other")
    _check_windows(timed, fail)
    if timed.unfolds or timed.expects is not None:
        _check_unfolding(timed, fail)
    return timed


def check_target(target: Target, count: int, index: int, fail: Any) -> None:
    """What one target says of place and time. Raises `fail(key, problem)`."""
    _finite(target.at, lambda p: fail("at", p))
    check_times(target, fail)
    for before in target.after:
        if not 0 <= before < count or before == index:
            raise fail("after", f"{before} is not allowed; another target's number, "
                       f"0 to {count - 1}")


def check_times(target: Any, fail: Any) -> None:
    """A target's seconds, be it a scenario's or a mission's. Raises `fail(key, problem)`."""
    for key, value in (("service", target.service), ("appears", target.appears)):
        if not 0 <= value <= MOST_SECONDS:
            raise fail(key, f"{value:g} is not allowed; seconds, at least 0, at most "
                       f"{MOST_SECONDS:g}")
    if target.lapses is not None and not target.appears <= target.lapses <= MOST_SECONDS:
        raise fail("lapses", f"{target.lapses:g} is not allowed; at least `appears`, "
                   f"{target.appears:g}: it would lapse before it appears; at most "
                   f"{MOST_SECONDS:g}")
    if not 0 <= target.worth <= MOST_WORTH:
        raise fail("worth", f"{target.worth:g} is not allowed; 0 to {MOST_WORTH:g}")
    if target.worth and target.lapses is None:
        raise fail("worth", "is of a target that may lapse; say after how many s: lapses")


def check_limit(seconds: float, fail: Any) -> None:
    """Raises `fail(problem)` for a limit that is no time."""
    if not 0 < seconds <= MOST_SECONDS:
        raise fail(f"{seconds:g} is not allowed; above 0, at most {MOST_SECONDS:g}")


def headcount(team: Iterable[tuple[str, ...]]) -> Counter[str]:
    """How many of the team have each skill."""
    return Counter(skill for its in team for skill in set(its))


def check_coalition(target: Any, have: Counter[str], fail: Any) -> None:
    """Raises `fail(key, problem)` for a coalition that the team, counted, can never form."""
    if target.coalition and target.skills:
        raise fail("coalition", "give skills or coalition, not both")
    if not target.coalition and (not target.skills or "" in target.skills):
        raise fail("skills", "at least one non-empty skill name is needed, or a coalition")
    for skill, number in target.coalition.items():
        if number < 1:
            raise fail(f"coalition.{skill}", f"{number} is not allowed; at least 1")
        if have[skill] < number:
            raise fail(f"coalition.{skill}", f"{number} agents with it are needed; the team has "
                       f"{have[skill]}")
    lacking = [skill for skill in target.skills if not have[skill]]
    if lacking and (target.type == "AND" or len(lacking) == len(set(target.skills))):
        raise fail("skills", f"no agent has {', '.join(sorted(lacking))}; the team has "
                   + ", ".join(sorted(have)))


def after_itself(after: list[tuple[int, ...]]) -> list[int]:
    """Targets on a circle of `after`, in order; empty where there is none."""
    waits = [set(before) for before in after]
    later: list[list[int]] = [[] for _ in after]
    for j, before in enumerate(waits):
        for k in before:
            later[k].append(j)
    free = [j for j, before in enumerate(waits) if not before]
    for k in free:
        for j in later[k]:
            waits[j].discard(k)
            if not waits[j]:
                free.append(j)
    return sorted(set(range(len(after))) - set(free))


def distance(a: Place, b: Place, metric: Metric) -> float:
    """Metres between two places."""
    x, y = a[0] - b[0], a[1] - b[1]
    return abs(x) + abs(y) if metric == "manhattan" else math.hypot(x, y)


def load(path: str | os.PathLike[str]) -> Timed:
    """One problem from a JSON file. Raises InputError."""
    return convert(files.read_json(path), path)


def load_set(path: str | os.PathLike[str]) -> list[Timed]:
    """A `.jsonl` set, one problem a line. Raises InputError naming the line."""
    return files.read_lines(
        path, lambda line, where: convert(json_value(line, path, where), path, where), "problem")


def save_set(path: str | os.PathLike[str], problems: Iterable[Timed]) -> None:
    """Writes a `.jsonl` set, whole or not at all."""
    files.write_lines(path, problems)


def by_the_clock(path: str | os.PathLike[str]) -> bool:
    """Whether a `.json` or `.jsonl` file holds problems by the clock, by their key `clock`.

    Lines that are no JSON say nothing. Raises InputError naming the line if a set holds both.
    """
    text = files.read_text(path)
    lines = files.lines(text) if os.fspath(path).endswith(".jsonl") else [text]
    first: bool | None = None
    for n, line in enumerate(lines, 1):
        clocked = _clocked(line) if line.strip() else None
        if clocked is None:
            continue
        if first is not None and clocked != first:
            kinds = ("in steps", "by the clock")
            raise InputError(path, f"is {kinds[clocked]}, the first {kinds[first]}; a set is one "
                             "or the other", f"line {n}")
        first = clocked
    return bool(first)


def convert(value: Any, source: object, where: str = "") -> Timed:
    """What was read, checked. Raises InputError."""
    return check(files.convert(value, Timed, source, where), source, where)


def _clocked(line: str) -> bool | None:
    """Whether it is an object with a key `clock`; None if it is no JSON."""
    try:
        value = msgspec.json.decode(line)
    except (msgspec.DecodeError, RecursionError):
        return None
    return isinstance(value, dict) and "clock" in value


def _check_agent(agent: Agent, fail: Any) -> None:
    _finite(agent.at, lambda p: fail("at", p))
    if agent.home is not None:
        _finite(agent.home, lambda p: fail("home", p))
    _positive(agent.speed, lambda p: fail("speed", p))
    if "" in agent.skills:
        raise fail("skills", "a skill name is empty")


def _check_ways(timed: Timed, fail: Any) -> None:
    """Raises for ways that take longer than planners can count."""
    places = [*(a.at for a in timed.agents), *(a.home for a in timed.agents if a.home),
              *(t.at for t in timed.targets)]
    wide = sum(max(along) - min(along) for along in zip(*places, strict=True))
    for i, agent in enumerate(timed.agents):
        if not wide / agent.speed <= MOST_SECONDS:
            raise fail(f"agents[{i}].speed", f"{agent.speed:g} is too slow: ways may take up to "
                       f"{wide / agent.speed:g} s; at most {MOST_SECONDS:g}")


def _check_windows(timed: Timed, fail: Any) -> None:
    """Raises for a window that is over before anybody who is needed can be there."""
    who: dict[str, list[int]] = {}
    for i, agent in enumerate(timed.agents):
        for skill in set(agent.skills):
            who.setdefault(skill, []).append(i)
    for j, target in enumerate(timed.targets):
        closes = target.lapses
        if target.worth:  # it need not be reached
            continue
        if timed.max_seconds is not None:
            last = timed.max_seconds - target.service
            closes = last if closes is None else min(closes, last)
        if closes is None:
            continue
        soonest = _soonest(timed, target, who)
        if soonest > closes + 1e-9:
            key = "lapses" if target.lapses is not None and closes == target.lapses else "at"
            raise fail(f"targets[{j}].{key}", f"{closes:g} s is over before it can be reached: its "
                       f"coalition can be there at {soonest:.3f} s at the soonest")


def _soonest(timed: Timed, target: Target, who: dict[str, list[int]]) -> float:
    """s at which a coalition can be at the target if everybody goes straight there.

    `who` has which skill.
    """
    there = [distance(a.at, target.at, timed.metric) / a.speed for a in timed.agents]
    arrivals = {skill: sorted(there[i] for i in who.get(skill, ())) for skill in target.needs()}
    times = [found[number - 1] for skill, number in target.needs().items()
             if len(found := arrivals[skill]) >= number]
    either = not target.coalition and target.type == "OR"
    return max(target.appears, min(times) if either else max(times))


def _check_unfolding(timed: Timed, fail: Any) -> None:
    """What nobody knows beforehand has to be possible, and what is expected has to be said."""
    for i, agent in enumerate(timed.agents):
        say = lambda key, problem, i=i: fail(f"agents[{i}].{key}", problem)
        if agent.sensor is not None:
            _positive(agent.sensor, lambda p, say=say: say("sensor", p))
        if agent.lost is not None and not 0 <= agent.lost <= MOST_SECONDS:
            raise say("lost", f"{agent.lost:g} is not allowed; seconds, at least 0, at most "
                      f"{MOST_SECONDS:g}")
        if agent.pace and len(agent.pace) != len(timed.targets):
            raise say("pace", f"has {len(agent.pace)} numbers; one for each of the "
                      f"{len(timed.targets)} targets is needed")
        for value in agent.pace:
            if not 0.01 <= value <= 100:
                raise say("pace", f"{value:g} is not allowed; 0.01 to 100")
    if timed.expects is not None:
        check_expects(timed.expects, fail)
    known = [not t.hidden and not t.following for t in timed.targets]
    for j, target in enumerate(timed.targets):
        say = lambda key, problem, j=j: fail(f"targets[{j}].{key}", problem)
        if target.following < 0 or (target.following and (target.hidden or target.appears)):
            raise say("following", f"{target.following} is not allowed; a number of targets, and "
                      "neither hidden nor appears beside it")
        if not all(known[k] for k in target.after):
            raise say("after", "it comes after a target that is hidden or follows on others")
        if target.hidden:
            _check_hidden(timed, target, say)
    counts = sorted(target.following for target in timed.targets)
    for solved, following in enumerate(counts):
        if following > solved:
            raise fail("targets", f"one follows on {following} others, and only {solved} can be "
                       "solved before it")


def check_expects(expects: Prospect, fail: Any) -> None:
    """Raises `fail(key, problem)` for expectations that cannot be."""
    if not 0 <= expects.more <= MOST_TARGETS:
        raise fail("expects.more", f"{expects.more} is not allowed; 0 to {MOST_TARGETS}")
    if expects.every is not None and not 0 < expects.every <= MOST_SECONDS:
        raise fail("expects.every", f"{expects.every:g} is not allowed; above 0, at most "
                   f"{MOST_SECONDS:g}")
    if expects.area is not None:
        west, south, east, north = expects.area
        if not (all(map(math.isfinite, expects.area)) and 0 <= east - west <= MOST_SIDE
                and 0 <= north - south <= MOST_SIDE):
            raise fail("expects.area", f"{list(expects.area)} is not allowed; west, south, east "
                       f"and north, at most {MOST_SIDE} m apart")
    if not 0 <= expects.scatter <= 2:
        raise fail("expects.scatter", f"{expects.scatter:g} is not allowed; 0 to 2")
    for key, span, most in (("worth", expects.worth, MOST_WORTH),
                            ("stays", expects.stays, MOST_SECONDS)):
        if span is not None and not 0 < span[0] <= span[1] <= most:
            raise fail(f"expects.{key}", f"{list(span)} is not allowed; the least and the most, "
                       f"above 0, at most {most:g}")
        if span is not None and expects.every is None:
            raise fail(f"expects.{key}", "is of targets that arrive; say how often: every")
    if expects.worth is not None and expects.stays is None:
        raise fail("expects.worth", "is of targets that may lapse; say after how long: stays")
    loss = expects.loss
    if loss is not None and not (0 <= loss.share <= 1 and 0 < loss.until <= MOST_SECONDS):
        raise fail("expects.loss", f"{loss.share:g} by {loss.until:g} s is not allowed; a share "
                   f"of 0 to 1, and seconds above 0, at most {MOST_SECONDS:g}")


def _check_hidden(timed: Timed, target: Target, fail: Any) -> None:
    """Raises for a hidden target that nobody can find."""
    if all(agent.sensor is None for agent in timed.agents):
        raise fail("hidden", "no agent has a sensor; give at least one agents[i].sensor in m")
    area = None if timed.expects is None else timed.expects.area
    if area is None:
        raise fail("hidden", "where to look is not said; give expects.area: west, south, east, "
                   "north in m")
    west, south, east, north = area
    if not (west <= target.at[0] <= east and south <= target.at[1] <= north):
        raise fail("at", f"{list(target.at)} is hidden and outside expects.area, {list(area)}")


def _finite(place: Place, fail: Any) -> None:
    if not all(math.isfinite(x) for x in place):
        raise fail(f"{list(place)} is not allowed; two finite numbers")


def _positive(value: float, fail: Any) -> None:
    if not (math.isfinite(value) and value > 0):
        raise fail(f"{value:g} is not allowed; above 0")
