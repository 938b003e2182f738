"""What a robot lives on: a battery and a solar panel, as a mission says them."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from moonteam.errors import InputError

MOST_WH, MOST_W = 1e6, 1e6


class Battery(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A battery of `capacity_wh`, full to a share `charge` at the start.

    `panel_w`: what its panel gives when it faces the sun. The panel stands upright and turns after
    the sun, as polar rovers have it: it gives panel_w times the cosine of the sun's elevation
    wherever the robot stands in sunlight. `idle_w` is drawn all the time, and to move the
    mechanical power of wheels and joints over `efficiency`; thrusters burn propellant instead.
    """

    capacity_wh: float
    panel_w: float = 0.0
    idle_w: float = 0.0
    charge: float = 1.0
    efficiency: float = 0.7

    def check(self, fail: Callable[[str, str], InputError]) -> None:
        """Raises what `fail` makes of a key and what is wrong with it."""
        for key, most in (("capacity_wh", MOST_WH), ("charge", 1.0), ("efficiency", 1.0)):
            value = getattr(self, key)
            if not 0 < value <= most:
                raise fail(key, f"{value:g} is not allowed; above 0, at most {most:g}")
        for key in ("panel_w", "idle_w"):
            value = getattr(self, key)
            if not 0 <= value <= MOST_W:
                raise fail(key, f"{value:g} is not allowed; 0 to {MOST_W:g}")
