"""The three kinds of robot: model and controller each."""

from moonteam.robots.base import RobotKind
from moonteam.robots.drone import DRONE
from moonteam.robots.legged import LEGGED
from moonteam.robots.wheeled import WHEELED

KINDS: dict[str, RobotKind] = {kind.name: kind for kind in (DRONE, LEGGED, WHEELED)}

__all__ = ["KINDS"]
