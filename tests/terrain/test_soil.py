"""Soils: their names, their scatter, and what a mission may say of them."""

from typing import get_args

import msgspec
import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.problem import mission as missions
from moonteam.problem.mission import SoilName
from moonteam.terrain.site import for_mission, make_site, with_soil
from moonteam.terrain.soil import SOILS, drawn, find

TEXT = """
map: {{size: [6, 6]}}
site: {{preset: flat, seed: 5{more}}}
robots: [{{name: r, kind: wheeled, skills: [A], start: [0, 0]}}]
targets: [{{at: [3, 3], skills: [A]}}]
"""


def loaded(tmp_path, more):
    path = tmp_path / "m.yaml"
    path.write_text(TEXT.format(more=more))
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
])
def test_what_cannot_be_is_said_in_one_line(tmp_path, more, words):
    with pytest.raises(InputError) as error:
        loaded(tmp_path, more)
    told = str(error.value)
    assert "\n" not in told
    assert words in told
