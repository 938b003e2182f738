"""The film of an execution: the scene in 3-D, close views of the robots, the map, the words.

Where nothing can be rendered the map alone fills the film. Sizes are pixels and even, as
h264 wants them.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from moonteam.problem.mission import Mission
from moonteam.report import video
from moonteam.robots.base import Glyph
from sim2grid.frame import Frame
from sim2grid.loop.record import Record
from sim2grid.measure.story import Replan, Story
from sim2grid.show.picture import (
    GREY,
    INK,
    NIGHT,
    OPEN,
    REPLAN,
    SOLVED,
    STATES,
    Ground,
    MapPicture,
    RobotMark,
    TargetMark,
    draw_replan,
    draw_robot,
    font,
    requirement,
    robot_color,
    skills_of,
)

WIDTH, HEIGHT = 854, 480
FPS = 20
LONGEST_S = 17.0  # of motion; what is longer is shown faster
SHORTEST_S = 9.0
HOLD_S = 2.0  # the last moment stands still
SPEEDS = (0.25, 0.5, 0.75, 1, 1.5, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 25, 30, 40, 50, 60, 80, 100)
MARGIN = 10
SIDE = 190  # of the map beside 3-D pictures
CLOSE = (168, 112)  # largest size of a robot's close view
AT_REST = 0.12  # m/s
NEWS_S = 1.6  # film seconds for which the cause of a new plan is told
FREE = (MARGIN, 9 * MARGIN, WIDTH - SIDE - 3 * MARGIN, HEIGHT - CLOSE[1] - 2 * MARGIN)
"""Left, top, right, bottom of what no map, list or close view covers."""


@dataclass(frozen=True)
class Moment:
    """What the film shows at one instant."""

    time_s: float
    index: int  # of the logged pose
    decision: int
    solved: frozenset[int]
    status: tuple[str, ...]  # one word a robot: moving, waiting, late, lost and why
    speeds: tuple[float, ...]  # m/s
    goals: tuple[npt.NDArray, ...]  # [2] m, where each robot is bound
    targets: int  # how many are known
    replans: tuple[Replan, ...]  # so far


class Views(Protocol):
    """The 3-D pictures of a moment."""

    def main(self, moment: Moment, qpos: npt.NDArray) -> npt.NDArray[np.uint8]:
        """[HEIGHT, WIDTH, 3]: the whole scene."""
        ...

    def close(self, moment: Moment, qpos: npt.NDArray, robot: int) -> npt.NDArray[np.uint8]:
        """[CLOSE[1], CLOSE[0], 3]: one robot from near by."""
        ...


def playback(seconds: float) -> float:
    """How many mission seconds pass in a second of film."""
    for speed in SPEEDS:
        if seconds / speed <= LONGEST_S:
            return speed
    return math.ceil(seconds / LONGEST_S)


class Film:
    """Cuts a record into frames; without `views` the map fills them."""

    def __init__(self, mission: Mission, record: Record, frame: Frame, ground: Ground,
                 bases: Sequence[int], title: str,
                 barred: npt.NDArray[np.bool_] | None = None, views: Views | None = None,
                 glyphs: Sequence[Glyph] = ()):
        self.mission, self.record, self.title, self.views = mission, record, title, views
        self.frame, self.ground, self.bases, self.barred = frame, ground, bases, barred
        # How each robot is marked on the map.
        self.glyphs: Sequence[Glyph] = glyphs or ("disc",) * len(mission.robots)
        self.story = Story(mission, record, frame, bases)
        self.times, self.qpos, self.paths = self.story.times, self.story.qpos, self.story.paths
        # A robot's close view is drawn afresh now and then, and when a target is solved.
        self._close: dict[int, tuple[frozenset[int], Image.Image]] = {}
        self.speed = playback(record.seconds())
        self.map = MapPicture(frame, ground, SIDE if views else HEIGHT - 2 * MARGIN, barred)

    def with_views(self, views: Views) -> Film:
        """The same film with 3-D pictures."""
        return Film(self.mission, self.record, self.frame, self.ground, self.bases, self.title,
                    self.barred, views, self.glyphs)

    def last_map(self, side: int) -> Image.Image:
        """The map at the end of the mission with every path, `side` pixels."""
        moment = self.moment(self.record.seconds())
        return MapPicture(self.frame, self.ground, side, self.barred).draw(*self._marks(moment))

    @property
    def num_frames(self) -> int:
        """Frames, the still ones at the end included."""
        moving = max(self.record.seconds() / self.speed, 0.0)
        return math.ceil(moving * FPS) + 1 + self._still

    @property
    def _still(self) -> int:
        """Frames for which the last moment is held; a short film is held longer."""
        return round(max(HOLD_S, SHORTEST_S + HOLD_S - self.record.seconds() / self.speed) * FPS)

    def frames(self) -> Iterator[npt.NDArray[np.uint8]]:
        """[HEIGHT, WIDTH, 3] pictures, in order."""
        last = None
        for k in range(self.num_frames - self._still):
            last = self.picture(k / FPS * self.speed)
            yield last
        for _ in range(self._still):
            if last is not None:
                yield last

    def moment(self, time_s: float) -> Moment:
        """What is going on at a mission second."""
        record, story = self.record, self.story
        time_s = min(time_s, record.seconds())
        decision = sum(d.time_s <= time_s + 1e-9 for d in record.decisions)
        robots = range(len(self.paths))
        status, goals = zip(*(story.state(i, time_s) for i in robots), strict=True)
        speeds = tuple(story.speed(i, time_s) for i in robots)
        # A robot that has arrived may still be coming to rest.
        status = tuple("moving" if word == "waiting" and speed > AT_REST else word
                       for word, speed in zip(status, speeds, strict=True))
        return Moment(
            time_s, story.index(time_s), decision, frozenset(record.solved_at(time_s)), status,
            speeds, goals, story.targets_at(decision),
            tuple(r for r in story.replans if r.time_s <= time_s + 1e-9))

    def picture(self, time_s: float) -> npt.NDArray[np.uint8]:
        """[HEIGHT, WIDTH, 3]: the film's picture of a mission second."""
        moment = self.moment(time_s)
        top = self.map.draw(*self._marks(moment), labels=self.views is None)
        if self.views is None:
            image = Image.new("RGB", (WIDTH, HEIGHT), NIGHT)
            image.paste(top, (MARGIN, MARGIN))
            side = self.map.size[0] + 3 * MARGIN
            pen = ImageDraw.Draw(image, "RGBA")
            self._words(pen, moment, (side, MARGIN))
            bottom = self._target_list(pen, moment, (side, 125), HEIGHT - 34 * len(self.paths))
            self._robot_list(pen, moment, (side, bottom + 14))
            return np.asarray(image)
        image = Image.fromarray(self.views.main(moment, self.qpos[moment.index]))
        pen = ImageDraw.Draw(image, "RGBA")
        left = WIDTH - MARGIN - top.width
        pen.rectangle([left - 3, MARGIN - 3, left + top.width + 2, MARGIN + top.height + 2],
                      fill=(*NIGHT, 255))
        image.paste(top, (left, MARGIN))
        self._words(pen, moment, (MARGIN, MARGIN - 2))
        free = self._close_views(image, pen, moment) < left
        self._target_list(pen, moment, (left, MARGIN + top.height + 8),
                          HEIGHT - MARGIN if free else FREE[3])
        return np.asarray(image)

    def _marks(self, moment: Moment) -> tuple[
            list[RobotMark], list[TargetMark], list[npt.NDArray]]:
        """Robots, targets and the places [2] m of new plans, for the map."""
        lost = {x.robot for x in self.record.losses if x.time_s <= moment.time_s + 1e-9}
        step = max(1, (moment.index + 1) // 1500)
        robots = []
        for i, spec in enumerate(self.mission.robots):
            path = self.paths[i][:moment.index + 1]
            thinned = np.concatenate([path[::step], path[-1:]])
            robots.append(RobotMark(spec.name, self.glyphs[i], thinned, i in lost))
        targets = [TargetMark(self.record.target_names[j], target, j in moment.solved)
                   for j, target in enumerate(self.record.targets[:moment.targets])]
        return robots, targets, [r.xy for r in moment.replans if r.xy is not None]

    def _words(self, pen: ImageDraw.ImageDraw, moment: Moment, at: tuple[int, int]) -> None:
        """Title, then time, decision and solved count, then news."""
        x, y = at
        _shadowed(pen, (x, y), self.title, 18, INK)
        done = len(moment.solved)
        _shadowed(pen, (x, y + 25), f"{moment.time_s:.1f} s  ({self.speed:g}x)   "
                  f"decision {moment.decision}", 15, INK)
        _shadowed(pen, (x, y + 46), f"solved {done} of {moment.targets}", 15,
                  SOLVED if done == moment.targets else INK)
        if moment.replans:
            width = pen.textlength(f"solved {done} of {moment.targets}", font(15, True))
            draw_replan(pen, (x + width + 24, y + 56), 6)
            _shadowed(pen, (x + width + 34, y + 46), f"{len(moment.replans)}", 15, REPLAN)
        if moment.time_s >= self.record.seconds() - 1e-9:
            word, color = ("mission complete", SOLVED) if self.record.success else (
                f"mission failed: {(self.record.failure or '').replace('_', ' ')}", OPEN)
            _shadowed(pen, (x, y + 67), word, 17, color)
        elif news := [r.words for r in moment.replans
                      if r.time_s > moment.time_s - NEWS_S * self.speed]:
            _shadowed(pen, (x, y + 67), f"replan: {', '.join(news[-2:])}", 15, REPLAN)

    def _target_list(self, pen: ImageDraw.ImageDraw, moment: Moment, at: tuple[int, int],
                     bottom: int) -> int:
        """The targets, closer together and in two columns where they are many; returns where
        the list ends.
        """
        x, y = at
        columns = 1 if (bottom - y) / max(moment.targets, 1) >= 13 else 2
        lines = max(1, math.ceil(moment.targets / columns))
        row = min(20.0, (bottom - y) / lines)
        for j, target in enumerate(self.record.targets[:moment.targets]):
            color = SOLVED if j in moment.solved else OPEN
            left, top = x + j // lines * SIDE // 2, round(y + j % lines * row)
            box = round(0.55 * row)
            pen.rectangle([left, top + 3, left + box, top + 3 + box], fill=(*NIGHT, 160),
                          outline=color, width=3 if row > 15 else 2)
            text = f"{self.record.target_names[j]}  {requirement(target)}"
            _shadowed(pen, (left + 18, top), text, max(8, round(0.66 * row)), color)
        return round(y + lines * row)

    def _robot_list(self, pen: ImageDraw.ImageDraw, moment: Moment, at: tuple[int, int]) -> None:
        x, y = at
        for i, spec in enumerate(self.mission.robots):
            draw_robot(pen, self.glyphs[i], (x + 7, y + 9), 7, robot_color(i))
            _shadowed(pen, (x + 20, y), f"{spec.name}  {spec.kind} {skills_of(spec)}", 13,
                      robot_color(i))
            _shadowed(pen, (x + 20, y + 16), _doing(moment, i), 12,
                      STATES.get(moment.status[i].split(":")[0], INK))
            y += 34

    def _close_views(self, image: Image.Image, pen: ImageDraw.ImageDraw, moment: Moment) -> int:
        """The strip along the bottom: each robot from near by, its name, kind and skills, what
        it does and how fast. Returns where the strip ends.
        """
        count = len(self.mission.robots)
        width = min(CLOSE[0], (WIDTH - (count + 1) * MARGIN) // count)
        y, x = HEIGHT - MARGIN - CLOSE[1], MARGIN
        number = round(moment.time_s / self.speed * FPS)
        for i, spec in enumerate(self.mission.robots):
            lost = moment.status[i].startswith("lost")
            color = GREY if lost else robot_color(i)
            pen.rectangle([x - 2, y - 2, x + width + 1, y + CLOSE[1] + 1], fill=(*color, 255))
            cut = (CLOSE[0] - width) // 2
            image.paste(self._close_view(moment, i, number).crop(
                (cut, 0, cut + width, CLOSE[1])), (x, y))
            draw_robot(pen, self.glyphs[i], (x + 12, y + 12), 6, color)
            _shadowed(pen, (x + 23, y + 3), spec.name, 12, color)
            _shadowed(pen, (x + 23, y + 18), f"{spec.kind} {skills_of(spec)}", 10, INK)
            word = moment.status[i]
            state = STATES.get(word.split(":")[0], INK)
            _shadowed(pen, (x + 6, y + CLOSE[1] - 18), word, 12, state)
            if not lost:
                speed = f"{moment.speeds[i]:.2f} m/s"
                wide = pen.textlength(speed, font(12, True))
                high = 18 if width > 140 else 34
                right = x + width - 6 - wide if width > 140 else x + 6
                _shadowed(pen, (right, y + CLOSE[1] - high), speed, 12, INK)
            x += width + MARGIN
        return x - MARGIN

    def _close_view(self, moment: Moment, robot: int, number: int) -> Image.Image:
        """[CLOSE]: drawn afresh in every second frame, in turn where robots are many."""
        held = self._close.get(robot)
        turns = max(2, len(self.mission.robots) // 2)
        if held is None or held[0] != moment.solved or (number + robot) % turns == 0:
            assert self.views is not None
            drawn = self.views.close(moment, self.qpos[moment.index], robot)
            held = self._close[robot] = moment.solved, Image.fromarray(drawn)
        return held[1]


def write(film: Film, path: str | os.PathLike[str],
          progress: Callable[[], None] = lambda: None) -> None:
    """Writes the film as h264, whole or not at all; `progress` is called after each frame."""
    with video.writing(path, (HEIGHT, WIDTH), FPS, crf=23) as add:
        for picture in film.frames():
            add(picture)
            progress()


def _doing(moment: Moment, robot: int) -> str:
    """As in: moving 0.42 m/s."""
    word = moment.status[robot]
    return word if word.startswith("lost") else f"{word}  {moment.speeds[robot]:.2f} m/s"


def _shadowed(pen: ImageDraw.ImageDraw, at: tuple[float, float], text: str, size: int,
              color: tuple[int, int, int]) -> None:
    pen.text(at, text, color, font(size, True), stroke_width=2, stroke_fill=NIGHT)
