"""The film's 3-D pictures of a small scene; skipped where there is no OpenGL."""

import numpy as np
import pytest

from moonteam.physics.render import RenderingUnavailable
from sim2grid.loop.prepare import prepare
from sim2grid.loop.record import Decision, Record, Solve
from sim2grid.show.film import CLOSE, HEIGHT, WIDTH, Film
from sim2grid.show.picture import Ground
from sim2grid.show.views import SceneViews


def test_both_cameras_see_the_robot_and_the_target_by_its_state(mission):
    spec = mission(["a drone A 0 0"], ["A OR 2 2"], size=(3, 3), site={"preset": "flat"})
    prepared = prepare(spec, "test")
    record = Record(list(spec.targets), ["T1"])
    poses = np.stack([prepared.scene.qpos0] * 3)
    poses[1:, 0] += np.array([1.0, 2.0])
    zeros = np.zeros((3, 1))
    record.log(np.arange(3.0), poses, zeros, zeros)
    zero = np.zeros((1, 2), np.int32)
    record.decisions = [Decision(0, 0.0, zero, np.array([3], np.int32), np.zeros(1, bool))]
    record.solves = [Solve(0, 1, 2.0, (0,), (0.0,))]
    site = prepared.site
    film = Film(spec, record, prepared.frame, Ground(site.heights, site.spacing),
                prepared.bases, "test")
    try:
        views = SceneViews(prepared, film)
    except RenderingUnavailable as reason:
        pytest.skip(str(reason))
    first, last = (views.main(m, poses[m.index]).astype(int)
                   for m in (film.moment(0.0), film.moment(2.0)))
    near = views.close(film.moment(0.0), poses[0], 0)
    views.shut()
    assert first.shape == (HEIGHT, WIDTH, 3)
    assert near.shape == (CLOSE[1], CLOSE[0], 3)
    assert near.std() > 5
    assert _more(first, 0, 1) > 200 > _more(first, 1, 0), "red: open"
    assert _more(last, 1, 0) > 200 > _more(last, 0, 1), "green: solved"


def _more(picture, channel, other):
    """Pixels in which one colour clearly outweighs another."""
    return int((picture[..., channel] - picture[..., other] > 60).sum())
