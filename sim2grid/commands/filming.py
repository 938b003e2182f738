"""The film of a rollout: its options, how it is begun and how it is ended."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from moonteam.errors import InputError
from moonteam.problem.mission import Mission
from moonteam.report.command import Aside
from moonteam.report.progress import bar

if TYPE_CHECKING:
    from sim2grid.loop.prepare import Prepared
    from sim2grid.show.studio import Shooting
    from sim2grid.show.take import Style, Take

PLAIN_S = 10.0
"""Between two lines on how far it is, where standard error is no terminal."""


@dataclass(frozen=True)
class Filmed:
    """How the film is made."""

    size: Aside[tuple[int, int]] = (1280, 720)
    """Width and height of the film, pixels, both even."""
    fps: Aside[float] = 30.0
    """Pictures a second."""
    seconds: Aside[float] = 24.0
    """Length of the film, title and end included; shorter where the mission is."""
    speed: Aside[float | None] = None
    """How fast wide pictures run, close ones being at true speed; the film is as long as that
    takes. Default: as --seconds asks for."""
    camera: Aside[str] = "auto"
    """auto cuts from wide pictures to whatever happens; wide, chase, or the name of a robot: one
    camera all the time, which goes along with it."""
    shadows: Aside[bool] = True
    """Robots cast shadows."""
    layout: Aside[Literal["inset", "clean", "map"]] = "inset"
    """inset: the map and the lists lie over the picture; clean: names alone; map: no 3-D picture,
    the map fills the film."""
    also: Aside[tuple[Literal["webp", "gif"], ...]] = ()
    """The film once more, small, for a README."""


def check(args: Filmed) -> None:
    """What can be said of the film's options alone. Raises InputError."""
    if any(n % 2 or not 160 <= n <= 3840 for n in args.size):
        raise InputError("--size", f"{args.size[0]} {args.size[1]} is not allowed; both even, "
                         "from 160 to 3840")
    for name, value, least, most in (
            ("--fps", args.fps, 1, 120), ("--seconds", args.seconds, 1, 3600),
            ("--speed", args.speed, 0.1, 1000)):
        if value is not None and not least <= value <= most:
            raise InputError(name, f"{value:g} is not allowed; from {least:g} to {most:g}")


def check_camera(args: Filmed, mission: Mission) -> None:
    """Raises InputError for a camera that goes along with nobody."""
    allowed = ["auto", "wide", "chase", *(robot.name for robot in mission.robots)]
    if args.camera not in allowed:
        raise InputError("--camera", f"no such camera or robot: {args.camera}; allowed: "
                         + ", ".join(allowed))


def begin(args: Filmed, take: Take, prepared: Prepared, out: Path) -> Shooting:
    """Begins video.mp4 in processes of its own; map.mp4 where there is nothing to render with,
    with a word about why.
    """
    from moonteam.physics.render import RenderingUnavailable
    from sim2grid.show.studio import Shooting

    name = "map.mp4"
    if args.layout != "map":
        from moonteam.physics import stage

        try:
            stage.check()
            tops = prepared.site.surface.tops
            take = replace(take, model=stage.painted(prepared.scene),
                           tops=take.ground.heights if tops is None else np.asarray(tops))
            name = "video.mp4"
        except RenderingUnavailable as error:
            print(f"moonteam: {error}", file=sys.stderr)
            print("moonteam: no 3-D video; making map.mp4 instead", file=sys.stderr)
    return Shooting(take, _style(args), out / name)


def end(args: Filmed, shooting: Shooting, timing: dict[str, float]) -> Path:
    """Waits for the film; writes it once more as is asked for."""
    from moonteam.report import video

    with bar("video", shooting.num_frames, plain_s=PLAIN_S) as update:
        cost = shooting.wait(lambda done: update(done, shooting.path.name))
    timing |= cost.timing()
    for kind in args.also:
        video.for_readme(shooting.path, shooting.path.with_suffix(f".{kind}"))
    return shooting.path


def _style(args: Filmed) -> Style:
    from sim2grid.show.take import Style

    return Style(args.size, args.fps, args.seconds, args.speed, args.camera, args.shadows,
                 args.layout)
