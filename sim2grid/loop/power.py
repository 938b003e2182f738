"""What robots live on while a mission is under way: batteries, panels, what it takes to move.

Where a robot stands in sunlight its panel gives `panel_w` times the cosine of the sun's elevation:
it stands upright and turns after the sun, which stands still. It draws `idle_w`, and the
mechanical power that its controller asks of wheels and joints over `efficiency`; what burns
propellant moves by that. Sunlight in W, charge in Wh.

Legend: R robots, T samples of a look.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from moonteam.problem.battery import Battery
from sim2grid.loop.asked import Asked

Floats = npt.NDArray[np.float64]
HOUR_S = 3600.0


@dataclass
class Charge:
    """One battery's account: `start_wh` + `gained_wh` - `used_wh` is `now_wh`."""

    battery: Battery
    now_wh: float = field(init=False)
    lowest_wh: float = field(init=False)
    gained_wh: float = 0.0  # from the sun; what a full battery cannot hold is not counted
    used_wh: float = 0.0
    dark_s: float = 0.0  # of `counted_s` in shadow
    counted_s: float = 0.0  # until the end, or until it was lost

    def __post_init__(self) -> None:
        self.now_wh = self.lowest_wh = self.start_wh

    @property
    def start_wh(self) -> float:
        """At the start."""
        return self.battery.charge * self.battery.capacity_wh

    @property
    def empty(self) -> bool:
        """Whether nothing is left, but for rounding."""
        return self.now_wh <= 1e-9

    def pass_time(self, moving_w: float, light: float, seconds: float) -> None:
        """Some seconds at a mean mechanical power; `light` is the share of panel_w that comes."""
        its, hours = self.battery, seconds / HOUR_S
        given = its.panel_w * light * hours
        used = min((its.idle_w + moving_w / its.efficiency) * hours, self.now_wh + given)
        gained = min(given, its.capacity_wh - self.now_wh + used)
        self.counted_s += seconds
        self.dark_s += 0.0 if light > 0.0 else seconds
        self.used_wh, self.gained_wh = self.used_wh + used, self.gained_wh + gained
        self.now_wh += gained - used
        self.lowest_wh = min(self.lowest_wh, self.now_wh)


class Power:
    """The batteries of a mission's robots, kept in the `charges` of a record."""

    def __init__(self, asked: Asked, charges: dict[int, Charge]):
        self._light = [body.light for body in asked.bodies]
        self._charges = charges
        for i, robot in enumerate(asked.mission.robots):
            if robot.battery is not None:
                charges[i] = Charge(robot.battery)

    def spend(self, present: npt.NDArray[np.bool_], xy: npt.NDArray, power: npt.NDArray,
              propellant: npt.NDArray, seconds: float) -> list[int]:
        """Takes a look of so many seconds; the robots whose batteries are empty now.

        Robots are those `present` [R], at xy [R, 2] m; power, propellant [T, R].
        """
        found = []
        for i, charge in self._charges.items():
            if not present[i]:
                continue
            watts = np.where(propellant[:, i] > 0.0, 0.0, power[:, i])
            charge.pass_time(float(np.mean(watts)), self._share(i, xy[i]), seconds)
            if charge.empty:
                found.append(i)
        return found

    def _share(self, robot: int, xy: npt.NDArray) -> float:
        """Of a panel's watts, what a robot at xy [2] m has."""
        light = self._light[robot]
        if light is None or not light.at(np.asarray(xy, np.float64)):
            return 0.0
        return math.cos(light.elevation)
