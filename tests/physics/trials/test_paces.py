"""How soil slows each kind, and what maps and fields then believe."""

import math
from dataclasses import replace

import numpy as np
import pytest

from moonteam import files
from moonteam.paths import assets
from moonteam.physics.trials.paces import Drive, measure, pace_of
from moonteam.robots import KINDS, team
from moonteam.terrain.site import make_site, with_soil
from moonteam.terrain.soil import SOILS

ROVER = KINDS.get("wheeled")


def drive(degrees, way, speed, through=3):
    return Drive(degrees, way, through, 3, speed if through else math.nan, 0.1, 0.003, 5.0)


def test_the_steepest_slope_is_where_two_fifths_of_the_speed_are_left():
    drives = [drive(0.0, "level", 0.5)]
    for slope, up in ((4.0, 0.4), (8.0, 0.3), (12.0, 0.1)):
        drives += [drive(slope, "up", up), drive(slope, "down", 0.5), drive(slope, "across", 0.5)]
    pace = pace_of(ROVER, drives)
    assert math.degrees(pace.max_slope) == pytest.approx(10.0, abs=0.01), "0.2 of 0.3 to 0.1"
    assert pace.speed == 0.5
    assert pace.slopes == tuple(round(math.radians(d), 4)
                                for d in (-12.0, -8.0, -4.0, 0.0, 4.0, 8.0, 12.0))
    # At 8 degrees 6 m take 20 + 12 + 12 s in place of 12 + 12 + 12: 0.18 of the speed is lost.
    assert pace.slowing == pytest.approx(0.18 / 0.8, abs=0.03)


def test_a_slope_that_most_drives_do_not_make_is_too_steep():
    drives = [drive(0.0, "level", 0.5)]
    for slope, through in ((8.0, 3), (16.0, 1)):
        drives += [drive(slope, way, 0.45, through) for way in ("up", "down", "across")]
    assert math.degrees(pace_of(ROVER, drives).max_slope) == pytest.approx(8.0, abs=0.01)


def test_the_bundled_paces_are_those_of_their_drives():
    soils = files.read_json(assets() / "robots" / "paces.json")["soils"]
    assert set(soils) == set(SOILS)
    for soil, by_kind in soils.items():
        for name, its in by_kind.items():
            drives = [Drive(**d | {k: math.nan if v is None and k != "slip" else v
                                   for k, v in d.items()}) for d in its["drives"]]
            told, kind = pace_of(KINDS.get(name), drives), KINDS.get(name)
            pace = kind.paces[soil]
            assert pace.max_slope <= kind.max_slope + 1e-4
            assert pace.speed <= kind.speed
            for a, b in zip(pace, told, strict=True):
                assert np.asarray(a) == pytest.approx(np.asarray(b), abs=6e-3), (soil, name)


def test_drives_today_are_as_the_bundled_paces_say():
    found = measure(ROVER, SOILS["nominal"], [0.0, 8.0], count=1, threads=1)
    pace = ROVER.paces["nominal"]
    assert found[0].speed_mps == pytest.approx(pace.speed, rel=0.05)
    up = next(d for d in found if d.way == "up")
    assert up.slip == pytest.approx(np.interp(math.radians(8.0), pace.slopes, pace.slip), abs=0.05)


def test_maps_know_the_soil_unless_they_are_told_that_ground_is_rigid():
    site = with_soil(make_site("mare", 0, 12.0), "nominal")
    kinds = {"wheeled": ROVER, "drone": KINDS.get("drone")}
    known, rigid = team.limits(kinds, site), team.limits(kinds, replace(site, known=False))
    assert known["wheeled"].max_slope == ROVER.paces["nominal"].max_slope
    assert known["wheeled"].speed < rigid["wheeled"].speed == ROVER.speed
    assert rigid["wheeled"] == ROVER.limits == team.limits(
        kinds, make_site("mare", 0, 12.0))["wheeled"]
    assert known["drone"] == rigid["drone"], "what flies does not touch it"
