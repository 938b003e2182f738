"""The three kinds of robot: model and controller each."""

from moonteam.robots.base import RobotKind
from moonteam.robots.drone import DRONE
from moonteam.robots.wheeled import WHEELED

KINDS: dict[str, RobotKind] = {"drone": DRONE, "wheeled": WHEELED}

__all__ = ["KINDS"]
