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

from moonteam import files
from moonteam.mission import Mission
from sim2grid.frames import Frame
from sim2grid.picture import (
    INK,
    NIGHT,
    OPEN,
    SOLVED,
    Ground,
    MapPicture,
    RobotMark,
    TargetMark,
    draw_robot,
    font,
    requirement,
    robot_color,
)
from sim2grid.record import Record

WIDTH, HEIGHT = 854, 480
FPS = 20
LONGEST_S = 17.0  # of motion; what is longer is shown faster
SHORTEST_S = 9.0
HOLD_S = 2.0  # the last moment stands still
SPEEDS = (0.25, 0.5, 0.75, 1, 1.5, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 25, 30, 40, 50, 60, 80, 100)
MARGIN = 10
CLOSE = (168, 112)  # size of a robot's close view
MAX_CLOSE = 3
FREE = (MARGIN, MARGIN, WIDTH - 220, HEIGHT - CLOSE[1] - 2 * MARGIN)
"""Left, top, right, bottom of what no map, list or close view covers."""


@dataclass(frozen=True)
class Moment:
    """What the film shows at one instant."""

    time_s: float
    index: int  # of the logged pose
    decision: int
    solved: frozenset[int]
    status: tuple[str, ...]  # one word a robot
    goals: tuple[npt.NDArray, ...]  # [2] m, where each robot is bound
    targets: int  # how many are known


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
                 barred: npt.NDArray[np.bool_] | None = None, views: Views | None = None):
        self.mission, self.record, self.title, self.views = mission, record, title, views
        self.frame, self.ground, self.bases, self.barred = frame, ground, bases, barred
        self.times = np.concatenate(record.times)
        self.qpos = np.concatenate(record.qpos)
        self.paths = [self.qpos[:, b:b + 2].astype(float) for b in bases]
        # Drawn afresh in every second frame, and when a target is solved.
        self._close: dict[int, tuple[frozenset[int], Image.Image]] = {}
        self.speed = playback(record.seconds())
        side = 190 if views else HEIGHT - 2 * MARGIN
        self.map = MapPicture(frame, ground, side, barred)

    def with_views(self, views: Views) -> Film:
        """The same film with 3-D pictures."""
        return Film(self.mission, self.record, self.frame, self.ground, self.bases, self.title,
                    self.barred, views)

    def last_map(self, side: int) -> Image.Image:
        """The map at the end of the mission with every path, `side` pixels."""
        robots, targets = self._marks(self.moment(self.record.seconds()))
        return MapPicture(self.frame, self.ground, side, self.barred).draw(robots, targets)

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
            last = self._compose(self.moment(k / FPS * self.speed))
            yield last
        for _ in range(self._still):
            if last is not None:
                yield last

    def moment(self, time_s: float) -> Moment:
        """What is going on at a mission second."""
        record = self.record
        time_s = min(time_s, record.seconds())
        index = min(int(np.searchsorted(self.times, time_s - 1e-9)), len(self.times) - 1)
        decision = sum(d.time_s <= time_s + 1e-9 for d in record.decisions)
        late = sum(1 for d, cause in record.replans if cause == "new_target" and d >= decision)
        status, goals = zip(*(self._robot_at(i, time_s) for i in range(len(self.paths))),
                            strict=True)
        return Moment(time_s, index, decision, frozenset(record.solved_at(time_s)), status,
                      goals, len(record.targets) - late)


    def _robot_at(self, robot: int, time_s: float) -> tuple[str, npt.NDArray]:
        """A word for what the robot does, and the point [2] m that it is bound for."""
        goal = self.paths[robot][0]
        word = "waits"
        for leg in self.record.legs:
            if leg.robot != robot or leg.start_s > time_s + 1e-9:
                continue
            goal = leg.waypoint
            under_way = leg.end_s is None or time_s < leg.end_s - 1e-9
            word = "moves" if leg.moving and under_way else "waits"
            if leg.ended == "timeout" and not under_way:
                word = "late"
        for loss in self.record.losses:
            if loss.robot == robot and loss.time_s <= time_s + 1e-9:
                word = loss.cause.replace("_", " ")
        return word, goal

    def _marks(self, moment: Moment) -> tuple[list[RobotMark], list[TargetMark]]:
        lost = {x.robot for x in self.record.losses if x.time_s <= moment.time_s + 1e-9}
        step = max(1, (moment.index + 1) // 1500)
        robots = []
        for i, spec in enumerate(self.mission.robots):
            path = self.paths[i][:moment.index + 1]
            thinned = np.concatenate([path[::step], path[-1:]])
            robots.append(RobotMark(spec.name, spec.kind, thinned, i in lost))
        targets = [TargetMark(self.record.target_names[j], target, j in moment.solved)
                   for j, target in enumerate(self.record.targets[:moment.targets])]
        return robots, targets

    def _compose(self, moment: Moment) -> npt.NDArray[np.uint8]:
        qpos = self.qpos[moment.index]
        robots, targets = self._marks(moment)
        top = self.map.draw(robots, targets, labels=self.views is None)
        if self.views is None:
            image = Image.new("RGB", (WIDTH, HEIGHT), NIGHT)
            image.paste(top, (MARGIN, MARGIN))
            side = self.map.size[0] + 3 * MARGIN
            pen = ImageDraw.Draw(image, "RGBA")
            self._words(pen, moment, (side, MARGIN))
            self._target_list(pen, moment, (side, 110))
            self._robot_list(pen, moment, (side, 130 + 22 * moment.targets))
            return np.asarray(image)
        image = Image.fromarray(self.views.main(moment, qpos))
        pen = ImageDraw.Draw(image, "RGBA")
        left = WIDTH - MARGIN - top.width
        pen.rectangle([left - 3, MARGIN - 3, left + top.width + 2, MARGIN + top.height + 2],
                      fill=(*NIGHT, 255))
        image.paste(top, (left, MARGIN))
        self._words(pen, moment, (MARGIN, MARGIN - 2))
        self._target_list(pen, moment, (left, MARGIN + top.height + 8))
        self._close_views(image, pen, moment, qpos)
        return np.asarray(image)

    def _words(self, pen: ImageDraw.ImageDraw, moment: Moment, at: tuple[int, int]) -> None:
        """Title, then time, decision and solved count."""
        x, y = at
        _shadowed(pen, (x, y), self.title, 18, INK)
        done = len(moment.solved)
        speed = f"{self.speed:g}x"
        _shadowed(pen, (x, y + 25),
                  f"{moment.time_s:5.1f} s   ({speed})    decision {moment.decision}", 15, INK)
        _shadowed(pen, (x, y + 46), f"solved {done} of {moment.targets}", 15,
                  SOLVED if done == moment.targets else INK)
        if moment.time_s >= self.record.seconds() - 1e-9:
            word, color = ("mission complete", SOLVED) if self.record.success else (
                f"mission failed: {(self.record.failure or '').replace('_', ' ')}", OPEN)
            _shadowed(pen, (x, y + 67), word, 17, color)

    def _target_list(self, pen: ImageDraw.ImageDraw, moment: Moment,
                     at: tuple[int, int]) -> None:
        x, y = at
        for j, target in enumerate(self.record.targets[:moment.targets]):
            color = SOLVED if j in moment.solved else OPEN
            pen.rectangle([x, y + 3, x + 11, y + 14], fill=(*NIGHT, 160), outline=color, width=3)
            text = f"{self.record.target_names[j]}  {requirement(target)}"
            _shadowed(pen, (x + 18, y), text, 13, color)
            y += 20

    def _robot_list(self, pen: ImageDraw.ImageDraw, moment: Moment, at: tuple[int, int]) -> None:
        x, y = at
        for i, spec in enumerate(self.mission.robots):
            draw_robot(pen, spec.kind, (x + 7, y + 9), 7, robot_color(i))
            skills = "".join(spec.skills)
            _shadowed(pen, (x + 20, y), f"{spec.name} ({skills})  {moment.status[i]}", 14,
                      robot_color(i))
            y += 22

    def _close_views(self, image: Image.Image, pen: ImageDraw.ImageDraw, moment: Moment,
                     qpos: npt.NDArray) -> None:
        """A strip along the bottom: each robot from near by, its skills, what it does."""
        if self.views is None:
            return
        width, height = CLOSE
        for i, spec in enumerate(self.mission.robots[:MAX_CLOSE]):
            x, y = MARGIN + i * (width + MARGIN), HEIGHT - MARGIN - height
            color = robot_color(i)
            pen.rectangle([x - 2, y - 2, x + width + 1, y + height + 1], fill=(*color, 255))
            even = round(moment.time_s / self.speed * FPS) % 2 == 0
            if even or i not in self._close or self._close[i][0] != moment.solved:
                drawn = Image.fromarray(self.views.close(moment, qpos, i))
                self._close[i] = (moment.solved, drawn)
            image.paste(self._close[i][1], (x, y))
            draw_robot(pen, spec.kind, (x + 12, y + 12), 6, color)
            _shadowed(pen, (x + 23, y + 3), f"{spec.name} ({''.join(spec.skills)})", 12, color)
            _shadowed(pen, (x + 6, y + height - 18), moment.status[i], 12, INK)


def write(film: Film, path: str | os.PathLike[str],
          progress: Callable[[], None] = lambda: None) -> None:
    """Writes the film as h264, whole or not at all; `progress` is called after each frame."""
    import imageio_ffmpeg
    import mediapy

    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    with (files.replacing(path) as temporary,
          mediapy.VideoWriter(temporary, (HEIGHT, WIDTH), codec="h264", fps=FPS,
                              crf=23) as writer):
        for picture in film.frames():
            writer.add_image(picture)
            progress()


def _shadowed(pen: ImageDraw.ImageDraw, at: tuple[float, float], text: str, size: int,
              color: tuple[int, int, int]) -> None:
    pen.text(at, text, color, font(size, True), stroke_width=2, stroke_fill=NIGHT)
