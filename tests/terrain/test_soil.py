"""Soils: their names, their scatter, and what a mission may say of them."""

import itertools
from typing import get_args

import msgspec
import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.problem import mission as missions
from moonteam.problem.mission import SoilName
from moonteam.robots import KINDS, team
from moonteam.terrain.site import for_mission, make_site, with_soil
from moonteam.terrain.soil import SOILS, drawn, find
from moonteam.terrain.travel.roads import Roads
from moonteam.terrain.traversability import ground_under

TEXT = """
map: {{size: [6, 6]}}
site: {{preset: flat, seed: 5{more}}}
robots: [{{name: r, kind: wheeled, skills: [A], start: [0, 0]}}]
targets: [{{at: [3, 3], skills: [A]}}]
"""


def loaded(tmp_path, more, preset="flat"):
    path = tmp_path / "m.yaml"
    text = TEXT.format(more=more)
    if preset != "flat":
        text = text.replace("flat", preset).replace("size: [6, 6]", "size: [20, 20]")
    path.write_text(text)
    return missions.load(path)


def test_missions_know_the_soils_that_there_are():
    assert set(get_args(SoilName)) == set(SOILS)


def test_a_soil_is_scattered_by_the_seed_about_itself():
    nominal = SOILS["nominal"]
    assert drawn(nominal, 3) == drawn(nominal, 3)
    assert drawn(nominal, 3) != drawn(nominal, 4)
    many = [drawn(nominal, seed) for seed in range(400)]
    logs = np.log([soil.k_phi / nominal.k_phi for soil in many])
    assert np.mean(logs) == pytest.approx(0.0, abs=0.04)
    assert np.std(logs) == pytest.approx(0.25, abs=0.03)
    angles = np.degrees([soil.friction - nominal.friction for soil in many])
    assert np.abs(angles).max() <= 2.0 + 1e-9
    assert np.mean(angles) == pytest.approx(0.0, abs=0.15)


def test_a_site_says_what_it_is_made_of():
    site = with_soil(make_site("mare", 2, 12.0), "dense")
    assert site.soil == drawn(SOILS["dense"], 2)
    assert site.meta["soil"]["name"] == "dense"
    assert site.meta["soil"]["friction"] == site.soil.friction
    assert site.surface.soft
    assert not make_site("mare", 2, 12.0).surface.soft
    with pytest.raises(InputError, match="dense"):
        find("dens")


def test_a_mission_chooses_its_ground(tmp_path):
    rigid = for_mission(loaded(tmp_path, ""))
    assert rigid.soil is None
    soft = for_mission(loaded(tmp_path, ", ground: regolith"))
    assert soft.soil is not None
    assert soft.soil.name == "nominal"
    assert soft.known
    blind = for_mission(loaded(tmp_path, ", ground: regolith, soil: loose, fields: rigid"))
    assert blind.soil is not None
    assert blind.soil.name == "loose"
    assert not blind.known
    assert msgspec.to_builtins(loaded(tmp_path, "").site) == {"preset": "flat", "seed": 5}


@pytest.mark.parametrize(("more", "words"), [
    (", ground: mud", "site.ground: unknown value 'mud'; allowed: regolith, rigid"),
    (", ground: regolith, soil: clay",
     "unknown value 'clay'; allowed: dense, grc1, loose, lunar, nominal"),
    (", soil: loose", "site.soil: is of ground: regolith, which is not given"),
    (", fields: rigid", "site.fields: is of ground: regolith, which is not given"),
    (", thrift: 0.5", "site.thrift: is of ground: regolith, which is not given"),
    (", ground: regolith, thrift: 2", "site.thrift: 2 is not allowed; 0 (time) to 1 (energy)"),
    (", ground: regolith, fields: rigid, thrift: 1", "site.thrift: needs fields: measured"),
])
def test_what_cannot_be_is_said_in_one_line(tmp_path, more, words):
    with pytest.raises(InputError) as error:
        loaded(tmp_path, more)
    told = str(error.value)
    assert "\n" not in told
    assert words in told


def test_thrift_saves_energy_for_time(tmp_path):
    """Way by way over the same ground: never more joules or fewer seconds, and for some less."""
    spent = {}
    for thrift in (0.0, 1.0):
        mission = loaded(tmp_path, f", ground: regolith, thrift: {thrift}", preset="highland")
        site = for_mission(mission)
        limits = team.limits({"wheeled": KINDS.get("wheeled")}, site)
        its = limits["wheeled"]
        roads = Roads.of_mission(site, mission, limits)
        rows = []
        open_ = [(x, y) for x in (-7.0, -2.0, 3.0, 8.0) for y in (-6.0, 0.0, 6.0)
                 if roads.passable("wheeled", np.array([x, y]))]
        for a, b in itertools.combinations(open_, 2):
            seconds = roads.seconds("wheeled", a, b)
            if seconds == np.inf:
                continue
            ends = np.asarray(roads.way("wheeled", a, b).points)
            share = (np.arange(20) + 0.5) / 20
            on = ends[:-1, None] + (ends[1:] - ends[:-1])[:, None] * share[:, None]
            slope, _ = ground_under(site, on, its.footprint)
            length = np.linalg.norm(ends[1:] - ends[:-1], axis=1)
            per_metre = np.interp(slope, *np.array(its.joules).T).mean(axis=1)
            rows.append((float((per_metre * length).sum()), seconds))
        spent[thrift] = np.array(rows)
    assert len(rows) > 8
    joules, seconds = (spent[1.0] / spent[0.0]).T
    assert (joules < 1.02).all()
    assert joules.min() < 0.98
    assert (seconds > 0.99).all()
