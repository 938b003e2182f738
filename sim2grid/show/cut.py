"""The cut of a film: which seconds of a mission it shows, how fast, and by which camera.

Close pictures run at true speed, or legs would strobe; between them wide ones run fast. Film
seconds are the viewer's, mission seconds the clock's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from sim2grid.measure.story import Story

Kind = Literal["title", "chase", "wide", "close", "end"]

TITLE_S, END_S = 2.0, 2.6  # film seconds of the cards
INTRODUCTION_S = 1.3  # of each robot at the start,
INTRODUCED = 4  # of this many at most,
INTRODUCTIONS = 0.22  # and this share of what moves
BEFORE_S, AFTER_S = 1.7, 0.9  # of a cutaway, about its event
CLOSE_SHARE = 0.42  # of what moves, for cutaways
SHORT_S = 1.5  # a gap this short between cutaways is filled at true speed
FASTEST = 4.0  # of a chase without cuts: more would be a blur
WEIGHTS = {"end": 6.0, "lost": 5.0, "wrong": 2.2, "new": 2.0, "solve": 3.0}


class Event(NamedTuple):
    """What is worth a cutaway."""

    time_s: float
    weight: float
    robot: int | None
    target: int | None
    words: str


@dataclass(frozen=True)
class Shot:
    """`frames` pictures of the mission seconds from `start_s` to `end_s`."""

    kind: Kind
    frames: int
    start_s: float
    end_s: float
    robot: int | None = None
    target: int | None = None
    words: str = ""

    def time(self, frame: int) -> float:
        """The mission second of a frame."""
        return self.start_s + (self.end_s - self.start_s) * frame / max(self.frames, 1)

    @property
    def happens_s(self) -> float:
        """The mission second of what a cutaway is about."""
        return self.end_s - AFTER_S

    def speed(self, fps: float) -> float:
        """Mission seconds a film second."""
        return (self.end_s - self.start_s) * fps / max(self.frames, 1)


def cut(story: Story, seconds: float, fps: float, *, camera: str = "auto",
        speed: float | None = None) -> tuple[Shot, ...]:
    """A film of about `seconds`; a shorter one where the mission is over sooner at true speed.

    Args:
      camera: auto (cuts), wide, chase (the first robot), or a robot's name (a chase).
      speed: of the wide pictures; the film is as long as that takes, whatever `seconds` says.
    """
    ends = story.record.seconds()
    lead, tail = min(TITLE_S, 0.1 * seconds), min(END_S, 0.13 * seconds)
    first = 0.0  # nothing moves behind the title
    motion = max(seconds - lead - tail, 0.5)
    if camera == "auto":
        parts = _cuts(story, first, ends, motion, speed)
    else:
        parts = _whole(story, first, ends, motion, camera, speed)
    shots = [("title", lead, 0.0, first, None, None, ""), *parts,
             ("end", tail, ends, ends, None, None, "")]
    found, film = [], 0.0
    for kind, length, start, end, robot, target, words in shots:
        frames = round((film + length) * fps) - round(film * fps)
        film += length
        if frames > 0:
            found.append(Shot(kind, frames, start, end, robot, target, words))
    return tuple(found)


def events(story: Story) -> list[Event]:
    """What a viewer should see from near by, in order of time."""
    record, names = story.record, story.record.target_names
    found = []
    for solve in record.solves:
        last = solve is record.solves[-1] and record.success
        found.append(Event(solve.time_s, WEIGHTS["end" if last else "solve"], None, solve.target,
                           f"{names[solve.target]} solved"))
    for loss in record.losses:
        found.append(Event(loss.time_s, WEIGHTS["lost"], loss.robot, None,
                           f"{story.mission.robots[loss.robot].name} lost"))
    for replan in story.replans:
        if replan.cause in ("timeout", "behind") and replan.robot is not None:
            found.append(Event(replan.time_s, WEIGHTS["wrong"], replan.robot, None, replan.words))
        if replan.cause == "new_target":
            name = replan.words.removeprefix("new target ")
            if name in names:
                found.append(Event(replan.time_s, WEIGHTS["new"], None, names.index(name),
                                   replan.words))
    return sorted(found, key=lambda event: event.time_s)


Part = tuple[Kind, float, float, float, int | None, int | None, str]


def _whole(story: Story, first: float, ends: float, motion: float, camera: str,
           speed: float | None) -> list[Part]:
    """One picture from start to end."""
    names = [robot.name for robot in story.mission.robots]
    robot = None if camera == "wide" else names.index(camera) if camera in names else 0
    rate = speed or max(1.0, (ends - first) / motion)
    kind: Kind = "wide" if robot is None else "chase"
    return [(kind, (ends - first) / rate, first, ends, robot, None, "")]


def _cuts(story: Story, first: float, ends: float, motion: float, speed: float | None
          ) -> list[Part]:
    """Introductions, then wide pictures with cutaways between."""
    count = min(len(story.mission.robots), INTRODUCED, int(INTRODUCTIONS * motion / INTRODUCTION_S))
    parts: list[Part] = []
    now = first
    for robot in range(count):
        until = min(now + INTRODUCTION_S, ends)
        if until > now:
            parts.append(("chase", until - now, now, until, robot, None, "introduction"))
        now = until
    span = BEFORE_S + AFTER_S
    chosen = _chosen(events(story), now, max(1, int(CLOSE_SHARE * motion / span)))
    # The last moment is looked at a little longer than the mission lasts.
    windows: list[tuple[float, float, Event]] = []
    for event in chosen:
        start = max(event.time_s - BEFORE_S, windows[-1][1] if windows else now)
        if start - (windows[-1][1] if windows else now) < SHORT_S:
            start = windows[-1][1] if windows else now
        windows.append((start, event.time_s + AFTER_S, event))
    close = sum(end - start for start, end, _ in windows)
    left = (ends - now) - sum(min(end, ends) - start for start, end, _ in windows)
    rate = speed or max(1.0, left / max(motion - (now - first) - close, 0.08 * motion))
    for start, end, event in windows:
        if start > now:
            parts.append(("wide", (start - now) / rate, now, start, None, None, ""))
        parts.append(("close", end - start, start, end, event.robot, event.target, event.words))
        now = end
    if ends > now + 1e-6:
        parts.append(("wide", (ends - now) / rate, now, ends, None, None, ""))
    return parts


def _chosen(found: Sequence[Event], after: float, count: int) -> list[Event]:
    """The weightiest events that leave each other room; of equals those spread widest."""
    left = [e for e in found if e.time_s > after]
    chosen: list[Event] = []
    while left and len(chosen) < count:
        def worth(event: Event) -> tuple[float, float]:
            apart = min((abs(event.time_s - e.time_s) for e in chosen), default=math.inf)
            return event.weight, min(apart, 1e6)

        best = max(left, key=worth)
        chosen.append(best)
        left = [e for e in left if abs(e.time_s - best.time_s) > BEFORE_S + AFTER_S]
    return sorted(chosen, key=lambda event: event.time_s)
