"""The film of an execution: 3-D pictures with names in them, the map, the words.

Where nothing can be rendered the map alone fills the film. Sizes are pixels; `unit` is what a
picture 720 pixels high calls one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from moonteam.problem.skills import held
from sim2grid.measure.story import Replan, Story
from sim2grid.show.cut import Shot, cut
from sim2grid.show.hud import Box, Label, Labels, card, chip, plate, put
from sim2grid.show.picture import (
    GREY,
    INK,
    NIGHT,
    OPEN,
    REPLAN,
    SOLVED,
    STATES,
    MapPicture,
    RobotMark,
    TargetMark,
    draw_replan,
    requirement,
    robot_color,
)
from sim2grid.show.take import Style, Take, ways

MARGIN = 14  # units
SIDE = 236  # of the map beside 3-D pictures, units
CHIP = (236, 50)  # a robot's plate, units
AT_REST = 0.12  # m/s
NEWS_S = 1.6  # film seconds for which the cause of a new plan is told
PATH_POINTS = 160  # of a driven path on the map
DIM: tuple[int, int, int] = (170, 178, 195)


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
    ways: tuple[npt.NDArray, ...]  # [n, 2] m, where each robot means to go, itself first


class Seen(NamedTuple):
    """A 3-D picture [h, w, 3], where names belong in it, and what they should leave free."""

    picture: npt.NDArray[np.uint8]
    labels: list[Label]
    covered: list[Box]


class Views(Protocol):
    """The 3-D pictures of a moment."""

    def seen(self, shot: int, share: float, moment: Moment, qpos: npt.NDArray) -> Seen:
        """What a shot's camera sees, `share` of the shot being over."""
        ...


class Film:
    """Cuts a take into pictures; without `views` the map fills them."""

    def __init__(self, take: Take, style: Style | None = None, views: Views | None = None):
        self.take, self.style, self.views = take, style or Style(), views
        self.mission, self.record = take.mission, take.record
        bases = [actor.base for actor in take.actors]
        self.story = Story(take.mission, take.record, take.frame, bases)
        self.times, self.qpos, self.paths = self.story.times, self.story.qpos, self.story.paths
        self.width, self.height = self.style.size
        self.unit = self.height / 720
        self.shots = cut(self.story, self.style.seconds, self.style.fps,
                         camera=self.style.camera, speed=self.style.speed)
        self._first = np.cumsum([0, *(shot.frames for shot in self.shots)])
        self._map: MapPicture | None = None
        self._still: tuple[int, Image.Image] | None = None  # behind a card, by its shot

    @property
    def num_frames(self) -> int:
        """Pictures, those of the cards included."""
        return int(self._first[-1])

    def shot_of(self, number: int) -> tuple[int, float]:
        """The shot of a picture, and which share of it is over."""
        index = int(np.searchsorted(self._first, number, side="right")) - 1
        index = min(index, len(self.shots) - 1)
        return index, (number - int(self._first[index])) / self.shots[index].frames

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
        index = story.index(time_s)
        coming = tuple(np.concatenate([self.paths[i][index:index + 1], ways(self.take, i, time_s)])
                       for i in robots)
        return Moment(
            time_s, index, decision, frozenset(record.solved_at(time_s)), status,
            speeds, goals, story.targets_at(decision),
            tuple(r for r in story.replans if r.time_s <= time_s + 1e-9), coming)

    def pose(self, time_s: float) -> npt.NDArray[np.float64]:
        """qpos [nq] at a mission second, between the logged ones."""
        after = self.story.index(time_s)
        before = max(after - 1, 0)
        gap = self.times[after] - self.times[before]
        share = 1.0 if gap <= 0 else float(np.clip((time_s - self.times[before]) / gap, 0.0, 1.0))
        first, last = (self.qpos[k].astype(float) for k in (before, after))
        for actor in self.take.actors:
            turn = slice(actor.base + 3, actor.base + 7)
            if first[turn] @ last[turn] < 0:
                last[turn] = -last[turn]
        return np.nan_to_num((1.0 - share) * first + share * last)

    def picture(self, number: int) -> npt.NDArray[np.uint8]:
        """[height, width, 3]: the film's picture of that number."""
        index, share = self.shot_of(number)
        shot = self.shots[index]
        time_s = min(shot.time(number - int(self._first[index])), self.record.seconds())
        moment = self.moment(time_s)
        if shot.kind in ("title", "end"):
            if self._still is None or self._still[0] != index:
                self._still = index, self._drawn(index, 0.5, moment, time_s)
            image = self._still[1]
        else:
            image = self._drawn(index, share, moment, time_s)
        if shot.kind == "title":
            image = card(image, self.title_lines(), self.unit, min(1.0, 6.0 * (1.0 - share)))
        if shot.kind == "end":
            image = card(image, self.end_lines(), self.unit, min(1.0, 0.2 + 4.0 * share))
        return np.asarray(image)

    def _drawn(self, index: int, share: float, moment: Moment, time_s: float) -> Image.Image:
        """A moment with all that lies over it, but for the cards."""
        shot = self.shots[index]
        if self.views is None:
            return self._map_alone(moment)
        seen = self.views.seen(index, share, moment, self.pose(time_s))
        image = Image.fromarray(seen.picture)
        if shot.kind in ("title", "end"):
            return image
        if self.style.layout == "clean":
            self._labels(seen.covered, []).draw(image, seen.labels)
        else:
            self._over(image, shot, moment, seen)
        return image

    def title_lines(self) -> list[tuple[str, float, tuple[int, int, int]]]:
        """Text, size and colour of each line of the first card."""
        mission = self.mission
        wide, high = (n * mission.map.cell_m for n in mission.map.size)
        hidden = sum(event.on_sight for event in mission.events)
        about = [_many(len(mission.robots), "robot")]
        about += [_many(len(mission.targets), "target")] if mission.targets or not hidden else []
        about += [_many(hidden, "hidden target")] if hidden else []
        lines = [(self.take.title, 46.0, INK),
                 (f"{', '.join(about)}, {wide:g} x {high:g} m", 24.0, DIM)]
        if self.take.about:
            lines.append((self.take.about, 20.0, DIM))
        for i, robot in enumerate(mission.robots[:6]):
            lines.append((f"{robot.name}: {robot.kind}, {held(robot.skills)}", 24.0,
                          robot_color(i)))
        return lines

    def end_lines(self) -> list[tuple[str, float, tuple[int, int, int]]]:
        """Text, size and colour of each line of the last card."""
        record = self.record
        word, color = ("Mission complete", SOLVED) if record.success else (
            f"Mission failed: {(record.failure or '').replace('_', ' ')}", OPEN)
        solved = len(record.solved_at(record.seconds()))
        lines = [(word, 46.0, color),
                 (f"{solved} of {_many(len(record.targets), 'target')} in {record.seconds():.1f} s"
                  f", {_many(len(record.decisions), 'decision')}", 28.0, INK)]
        lines += [(line, 22.0, DIM) for line in self.take.optimum]
        if self.take.optimum and (record.losses or len(record.targets) > len(
                self.mission.targets)):
            lines.append(("both for what was known at the start", 18.0, DIM))
        return [*lines, (self.take.title, 20.0, DIM)]

    def _over(self, image: Image.Image, shot: Shot, moment: Moment, seen: Seen) -> None:
        """All that lies over a 3-D picture."""
        u, margin = self.unit, MARGIN * self.unit
        top = self._map_picture(round(SIDE * u)).draw(*self._marks(moment, PATH_POINTS),
                                                      labels=False, wished=moment.ways)
        left = round(self.width - margin - top.width)
        plate(image, (left - 4, margin - 4, left + top.width + 3, margin + top.height + 3), 235)
        image.paste(top, (left, round(margin)))
        bottom = self._target_list(image, moment, (left, margin + top.height + 10 * u))
        hidden = [(left - 6.0, 0.0, float(self.width), float(bottom)),
                  (0.0, 0.0, 360 * u, 118 * u), *self._strip(image, moment)]
        caption = self._words(image, shot, moment)
        self._labels(seen.covered, [*hidden, *caption]).draw(image, seen.labels)

    def _labels(self, covered: list[Box], hidden: list[Box]) -> Labels:
        return Labels((self.width, self.height), [*covered, *hidden], hidden,
                      round(16 * self.unit))

    def _map_picture(self, side: int) -> MapPicture:
        if self._map is None:
            self._map = MapPicture(self.take.frame, self.take.ground, side, self.take.barred)
        return self._map

    def _map_alone(self, moment: Moment) -> Image.Image:
        """The map, the words and the lists: where there are no 3-D pictures."""
        u = self.unit
        image = Image.new("RGB", (self.width, self.height), NIGHT)
        top = self._map_picture(round(self.height - 2 * MARGIN * u)).draw(
            *self._marks(moment, PATH_POINTS), wished=moment.ways)
        image.paste(top, (round(MARGIN * u), round(MARGIN * u)))
        left = top.width + 3 * MARGIN * u
        self._clock(image, moment, (left, 60 * u))
        put(image, (left, MARGIN * u), self.take.title, round(20 * u))
        bottom = self._target_list(image, moment, (left, 170 * u))
        for i in range(len(self.mission.robots)):
            y, right = bottom + (20 + 58 * i) * u, min(left + 300 * u, self.width - 4)
            if y + 50 * u < self.height and left + 60 * u < right:  # else no room beside the map
                self._chip(image, moment, i, (left, y, right, y + 50 * u))
        return image

    def _marks(self, moment: Moment, points: int) -> tuple[
            list[RobotMark], list[TargetMark], list[npt.NDArray]]:
        """Robots, targets and the places [2] m of new plans, for the map."""
        lost = {x.robot for x in self.record.losses if x.time_s <= moment.time_s + 1e-9}
        step = max(1, (moment.index + 1) // points)
        robots = []
        for i, spec in enumerate(self.mission.robots):
            path = self.paths[i][:moment.index + 1]
            thinned = np.concatenate([path[::step], path[-1:]])
            eyes = spec.sensor_m if self.mission.searches else None
            robots.append(RobotMark(spec.name, self.take.actors[i].glyph, thinned, i in lost, eyes))
        targets = [TargetMark(self.record.target_names[j], target, j in moment.solved)
                   for j, target in enumerate(self.record.targets[:moment.targets])]
        return robots, targets, [r.xy for r in moment.replans if r.xy is not None]

    def _words(self, image: Image.Image, shot: Shot, moment: Moment) -> list[Box]:
        """Title, clock and speed at the top, what a picture is about above the strip.

        Returns the box of the latter, if there is any.
        """
        u = self.unit
        plate(image, (4 * u, 4 * u, 352 * u, 112 * u), 110)
        put(image, (MARGIN * u, 10 * u), self.take.title, round(18 * u))
        y = self._clock(image, moment, (MARGIN * u, 36 * u), shot.speed(self.style.fps))
        news = [r.words for r in moment.replans
                if r.time_s > moment.time_s - NEWS_S * max(shot.speed(self.style.fps), 1.0)]
        if news and shot.kind != "end":
            put(image, (MARGIN * u, y), f"new plan: {', '.join(news[-2:])}", round(16 * u), REPLAN)
        caption, color = shot.words, INK
        if shot.words == "introduction" and shot.robot is not None:
            robot = self.mission.robots[shot.robot]
            caption = f"{robot.name}: {robot.kind}, {held(robot.skills)}"
            color = robot_color(shot.robot)
        elif shot.target is not None and shot.words.endswith("solved"):
            done = shot.target in moment.solved
            name = self.record.target_names[shot.target]
            caption = shot.words if done else (
                f"{name} needs {requirement(self.record.targets[shot.target])}")
            color = SOLVED if done else OPEN
        elif shot.kind == "close" and moment.time_s < shot.happens_s - 1e-6:
            caption = "" if shot.robot is None else self.mission.robots[shot.robot].name
        if not caption:
            return []
        top = self.height - (CHIP[1] + MARGIN + 52) * u
        wide = put(image, (MARGIN * u, top), caption, round(30 * u), color)
        return [(0.0, top, MARGIN * u + wide, top + 40 * u)]

    def _clock(self, image: Image.Image, moment: Moment, at: tuple[float, float],
               speed: float | None = None) -> float:
        """Time, speed, decision, how many targets are solved; returns where it ends."""
        u, (x, y) = self.unit, at
        minutes, seconds = divmod(moment.time_s, 60.0)
        wide = put(image, (x, y), f"{int(minutes)}:{seconds:04.1f}", round(30 * u))
        if speed is not None and speed > 0:
            words = "true speed" if abs(speed - 1.0) < 0.05 else f"{speed:.2g} times true speed"
            put(image, (x + wide + 14 * u, y + 10 * u), words, round(17 * u), DIM)
        done = len(moment.solved)
        said = f"{done} of {_many(moment.targets, 'target')} solved"
        wide = put(image, (x, y + 44 * u), said if moment.targets else "no target known yet",
                   round(17 * u), SOLVED if moment.targets and done == moment.targets else INK)
        if moment.replans:
            pen = ImageDraw.Draw(image, "RGBA")
            draw_replan(pen, (x + wide + 20 * u, y + 56 * u), 8 * u)
            put(image, (x + wide + 32 * u, y + 44 * u), f"{len(moment.replans)}", round(17 * u),
                REPLAN)
        return y + 70 * u

    def _target_list(self, image: Image.Image, moment: Moment, at: tuple[float, float]) -> float:
        """The targets, closer together and in two columns where they are many; returns where
        the list ends.
        """
        u, (x, y) = self.unit, at
        if not moment.targets:
            return y
        bottom = self.height - (CHIP[1] + 2 * MARGIN) * u
        columns = 1 if (bottom - y) / max(moment.targets, 1) >= 15 * u else 2
        lines = max(1, math.ceil(moment.targets / columns))
        row = min(23.0 * u, (bottom - y) / lines)
        end = y + lines * row
        plate(image, (x - 4, y - 3, x + SIDE * u + 3, end + 3), 120)
        pen = ImageDraw.Draw(image, "RGBA")
        for j, target in enumerate(self.record.targets[:moment.targets]):
            color = SOLVED if j in moment.solved else OPEN
            left, top = x + j // lines * SIDE * u / 2 + 4, y + j % lines * row
            box = 0.5 * row
            pen.rectangle([left, top + 0.25 * row, left + box, top + 0.25 * row + box],
                          fill=(*color, 255) if j in moment.solved else None,
                          outline=color, width=2)
            size = max(8, round(0.66 * row))
            wide = put(image, (left + 0.5 * row + 8 * u, top + 0.04 * row),
                       self.record.target_names[j], size, color)
            if columns == 1:
                put(image, (left + 0.5 * row + 16 * u + wide, top + 0.08 * row),
                    requirement(target), round(0.9 * size), DIM)
        return end

    def _strip(self, image: Image.Image, moment: Moment) -> list[Box]:
        """The robots' plates along the bottom; returns their boxes."""
        u, count = self.unit, len(self.mission.robots)
        gap = MARGIN * u
        wide = min(CHIP[0] * u, (self.width - gap) / count - gap)
        boxes = []
        for i in range(count):
            x = gap + i * (wide + gap)
            box = (x, self.height - gap - CHIP[1] * u, x + wide, self.height - gap)
            self._chip(image, moment, i, box)
            boxes.append(box)
        return boxes

    def _chip(self, image: Image.Image, moment: Moment, robot: int, box: Box) -> None:
        spec, word = self.mission.robots[robot], moment.status[robot]
        lost = word.startswith("lost")
        color = GREY if lost else robot_color(robot)
        state = word if lost else f"{word}  {moment.speeds[robot]:.2f} m/s"
        chip(image, box, self.take.actors[robot].glyph, color,
             [(f"{spec.name}  {held(spec.skills)}", color),
              (state, STATES.get(word.split(":")[0], INK))], self.unit)


def _many(count: int, word: str) -> str:
    return f"{count} {word}" + ("" if count == 1 else "s")
