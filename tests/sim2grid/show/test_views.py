"""The film's 3-D pictures of a small scene; skipped where there is no OpenGL."""

from dataclasses import replace

import numpy as np
import pytest

from moonteam.physics import stage
from moonteam.physics.render import RenderingUnavailable
from sim2grid.loop.prepare import prepare
from sim2grid.loop.record import Decision, Record, Solve
from sim2grid.show.film import Film
from sim2grid.show.picture import Ground
from sim2grid.show.take import Style, Take, actors_of
from sim2grid.show.views import SceneViews


@pytest.fixture(scope="module")
def take(mission):
    spec = mission(["a drone A 0 0"], ["A OR 2 2"], size=(3, 3), site={"preset": "flat"})
    prepared = prepare(spec, "test")
    record = Record(list(spec.targets), ["T1"])
    poses = np.stack([prepared.scene.qpos0] * 3)
    poses[1:, 0] += np.array([1.0, 2.0])
    burning = np.array([[0.0], [0.002], [0.002]])
    record.log(np.arange(3.0), poses, np.zeros((3, 1)), burning)
    zero = np.zeros((1, 2), np.int32)
    record.decisions = [Decision(0, 0.0, zero, np.array([3], np.int32), np.zeros(1, bool))]
    record.solves = [Solve(0, 1, 2.0, (0,), (0.0,))]
    site = prepared.site
    return Take(spec, record, prepared.frame, Ground(site.heights, site.spacing), "test",
                actors_of(prepared), model=stage.painted(prepared.scene), tops=site.heights)


@pytest.fixture
def made(take):
    film = Film(take, Style((640, 360), seconds=6.0))
    try:
        views = SceneViews(film)
    except RenderingUnavailable as reason:
        pytest.skip(str(reason))
    yield film, views
    views.shut()


def test_every_camera_sees_the_robot_and_the_target_by_its_state(made):
    film, views = made
    kinds = {shot.kind: k for k, shot in enumerate(film.shots)}
    assert {"title", "close", "end"} <= set(kinds)
    first, last = film.moment(0.0), film.moment(2.0)
    red, green = (views.seen(kinds[kind], 0.5, moment, film.pose(moment.time_s))
                  for kind, moment in (("title", first), ("end", last)))
    assert red.picture.shape == (360, 640, 3)
    assert _more(red.picture, 0, 1) > 60 > _more(red.picture, 1, 0), "red: open"
    assert _more(green.picture, 1, 0) > 60 > _more(green.picture, 0, 1), "green: solved"
    near = views.seen(kinds["close"], 0.5, last, film.pose(2.0))
    assert {label.text for label in near.labels} == {"a", "T1"}
    (left, top, right, bottom), = near.covered
    assert left > 0
    assert right < 640
    assert top > 0
    assert bottom < 360, "the robot is in the picture"


def test_a_burning_thruster_has_a_plume(made):
    film, views = made
    assert views._plumes(film.moment(0.0), film.pose(0.0)) == []
    plumes = views._plumes(film.moment(1.0), film.pose(1.0))
    assert len(plumes) == 8, "four thrusters, a core and what is around it"
    base = film.pose(1.0)[:3]
    assert all(plume.position[2] < base[2] for plume in plumes)


def test_cameras_stand_over_the_ground_and_see_over_walls(take):
    y, _ = np.mgrid[-14:15, -14:15] * 0.25
    walls = np.where(np.abs(y) > 1.4, 2.0, 0.0)
    film = Film(replace(take, tops=walls), Style((640, 360), seconds=6.0))
    try:
        views = SceneViews(film)
    except RenderingUnavailable as reason:
        pytest.skip(str(reason))
    for index in range(len(film.shots)):
        view = views._view(index, 0.5, film.moment(1.0), film.pose(1.0))
        line = view.aim + np.linspace(0.12, 1.0, 20)[:, None] * (view.eye - view.aim)
        assert (line[:, 2] > views.top(line[:, :2]) - 0.02).all()
    views.shut()


def _more(picture, channel, other):
    """Pixels in which one colour clearly outweighs another."""
    values = picture.astype(int)
    return int((values[..., channel] - values[..., other] > 60).sum())
