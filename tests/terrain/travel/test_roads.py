import itertools

import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.robots import KINDS
from moonteam.terrain.site import Site, make_site
from moonteam.terrain.travel import Roads, field, roads
from moonteam.terrain.travel.raster import Raster, slowness
from moonteam.terrain.traversability import Limits, passable, traversability

LIMITS = {kind: KINDS.get(kind).limits for kind in KINDS.names()}
SLOWED = Limits(footprint=0.3, max_slope=0.4, max_step=9.0, speed=0.5, slowing=0.4, flies=False)


def on_open_ground(speed=0.5, size=(32, 32), shut=()):
    """Level ground; points [H, W] at `shut` (rows, columns) are closed."""
    raster = Raster(size, 1.0)
    slow = np.full(raster.shape, 1 / speed)
    for place in shut:
        slow[place] = np.inf
    return Roads.of_slowness(raster, {"robot": slow})


def walled():
    """20 x 20 m with a wall half a metre thick on x = 0, open from y = 3 m to 5 m."""
    wall = [(slice(0, 53), slice(39, 42)), (slice(60, None), slice(39, 42))]
    return on_open_ground(1.0, (20, 20), wall)


def crossed(network, kind, points):
    """Seconds along a polygon, and whether it is open all along, by sampling it finely."""
    slow, seconds, able = network.slowness(kind), 0.0, True
    for a, b in itertools.pairwise(points):
        length = float(np.linalg.norm(b - a))
        share = (np.arange(4000) + 0.5) / 4000
        on = a + share[:, None] * (b - a)
        half = np.array(slow.shape[::-1]) // 2
        at = np.floor(on / network.raster.spacing + half + 0.5).astype(int)
        at = np.clip(at, 0, 2 * half)
        able &= np.isinf(slow[at[:, 1], at[:, 0]]).mean() < 1e-3
        seconds += length * slow[at[:, 1], at[:, 0]].mean()
    return seconds, able


@pytest.fixture(scope="module", params=["mare", "highland"])
def network(request):
    return Roads.over(make_site(request.param, 3, 32.0), (24, 24), 1.0, LIMITS)


@pytest.mark.parametrize("to", [(0.0, 0.0), (-14.3, 9.1), (15.9, -15.9), (0.07, 12.34)])
def test_on_open_ground_it_is_the_straight_line(to):
    corner = on_open_ground(shut=[(0, 0)])  # closed at a corner, so that it has to march
    xy = corner.raster.points()
    found = corner.field("robot", to)
    straight = np.linalg.norm(xy - to, axis=-1) / 0.5
    assert np.isinf(found[0, 0])
    able = np.isfinite(found)
    assert able.sum() == able.size - 1
    np.testing.assert_allclose(found[able], straight[able], rtol=0.006, atol=1e-9)
    assert (found[able] >= straight[able] - 1e-9).all()
    np.testing.assert_allclose(on_open_ground().field("robot", to), straight, atol=1e-9)


def test_every_direction_from_between_the_points():
    corner = on_open_ground(2.0, shut=[(0, 0)])
    to = np.array([1.11, -2.22])
    for angle, far in itertools.product(np.linspace(0, 6.28, 41), (0.03, 0.9, 2.1, 5.0, 13.0)):
        start = to + far * np.array([np.cos(angle), np.sin(angle)])
        assert corner.seconds("robot", start, to) == pytest.approx(far / 2, rel=0.02)
        there = corner.way("robot", start, to)
        assert len(there.points) == 2
        assert there.seconds == pytest.approx(far / 2)


@pytest.mark.parametrize("start", [(-8.0, -6.0), (-3.0, 0.0), (-9.0, 9.5), (-0.7, -9.0)])
@pytest.mark.parametrize("to", [(8.0, -7.0), (0.9, 0.0), (5.0, 4.0)])
def test_a_way_goes_through_the_gap_of_a_wall(start, to):
    network = walled()
    way = network.way("robot", start, to)
    seconds, able = crossed(network, "robot", way.points)
    assert able
    assert way.seconds == pytest.approx(seconds, rel=1e-3)
    # The wall's points reach half a step farther, as squares: the gap's four corners.
    corners = [np.array([x, y]) for x in (-0.375, 0.375) for y in (3.125, 4.875)]
    exact = shortest(np.array(start), np.array(to), corners)
    assert way.seconds == pytest.approx(exact, rel=0.02)
    assert way.seconds >= exact - 1e-9
    assert network.seconds("robot", start, to) == pytest.approx(way.seconds, rel=0.05)
    assert len(way.points) <= 4


def shortest(start, to, corners):
    """Length of the shortest way through the gap: over none to two of its corners."""
    def clear(a, b):
        y = a[1] + (np.array([-0.375, 0.375]) - a[0]) / (b[0] - a[0] or 1e-12) * (b[1] - a[1])
        inside = min(a[0], b[0]) < 0.375 and max(a[0], b[0]) > -0.375
        return not inside or ((y >= 3.125 - 1e-9) & (y <= 4.875 + 1e-9)).all()

    best = np.inf
    for count in range(3):
        for over in itertools.permutations(corners, count):
            points = [start, *over, to]
            legs = list(itertools.pairwise(points))
            if all(clear(a, b) or abs(a[0] - b[0]) < 1e-9 for a, b in legs):
                best = min(best, sum(float(np.linalg.norm(b - a)) for a, b in legs))
    return best


def test_slopes_slow_and_a_detour_pays_where_the_hill_is_steep():
    """Against the sum of slowness along the line, where the plane's slope is known."""
    x = np.arange(-60, 61) * 0.25
    heights = np.tile(np.where(x > 0, np.tan(0.3) * x, 0.0), (121, 1)).astype(np.float32)
    network = Roads.over(Site("hill", 0, heights, 0.25), (20, 20), 1.0, {"robot": SLOWED})
    level, steep = 1 / 0.5, 1 / (0.5 * (1 - 0.4 * 0.3 / 0.4))
    assert network.slowness("robot")[40, 0] == pytest.approx(level)
    assert network.slowness("robot")[40, 80] == pytest.approx(steep, rel=1e-3)
    found = network.seconds("robot", (-9.0, 0.0), (9.0, 0.0))
    assert found == pytest.approx(9 * level + 9 * steep, rel=0.01)
    assert network.seconds("robot", (-9.0, -9.0), (-9.0, 9.0)) == pytest.approx(18 * level,
                                                                                rel=0.006)
    # Between two places on the slope part of the way is better on the level, as light goes.
    bent = network.way("robot", (0.6, -9.0), (0.6, 9.0))
    straight, _ = crossed(network, "robot", np.array([(0.6, -9.0), (0.6, 9.0)]))
    assert bent.seconds < straight
    assert bent.points[1:-1, 0].min() < 0.0
    assert network.seconds("robot", (0.6, -9.0), (0.6, 9.0)) == pytest.approx(bent.seconds,
                                                                              rel=0.02)


@pytest.mark.parametrize("kind", KINDS.names())
def test_fields_say_what_ways_take(network, kind):
    rng = np.random.default_rng(5)
    tried = 0
    while tried < 40:
        start, to = rng.uniform(-12, 12, (2, 2))
        if not network.passable(kind, start) or not network.passable(kind, to):
            continue
        tried += 1
        told = network.seconds(kind, start, to)
        if np.isinf(told):
            continue
        way = network.way(kind, start, to)
        seconds, able = crossed(network, kind, way.points)
        assert able
        assert way.seconds == pytest.approx(seconds, rel=1e-3)
        assert told == pytest.approx(way.seconds, rel=0.05)
        assert told >= np.linalg.norm(to - start) * network.slowness(kind).min() - 1e-9
        np.testing.assert_array_equal(way.points[[0, -1]], [start, to])
        assert way.arrivals(7.0)[-1] == pytest.approx(7.0 + way.seconds)
        assert way.metres >= np.linalg.norm(to - start) - 1e-9


@pytest.mark.parametrize("kind", KINDS.names())
def test_over_a_third_place_it_is_not_quicker(network, kind):
    rng = np.random.default_rng(6)
    places = rng.uniform(-12, 12, (14, 2))
    places = places[[network.passable(kind, place) for place in places]]
    seconds = network.matrix(kind, places, places)
    np.testing.assert_allclose(seconds, seconds.T, rtol=0.03)
    over = (seconds[:, :, None] + seconds[None, :, :]).min(axis=1)
    assert (over >= seconds * 0.98).all()
    assert np.diag(seconds) == pytest.approx(0.0)
    for i, j in ((0, 1), (3, 2)):
        assert network.seconds(kind, places[i], places[j]) == seconds[i, j]


def test_whoever_can_go_by_cells_can_go_here():
    """Neighbouring cells that are both open to a kind are joined, straight."""
    site = make_site("highland", 3, 32.0)
    network = Roads.over(site, (24, 24), 1.0, LIMITS)
    for kind, able in traversability(site, (24, 24), 1.0, LIMITS).items():
        for y, x in np.argwhere(able[:, :-1] & able[:, 1:])[::7]:
            a, b = network.centre((x, y)), network.centre((x + 1, y))
            assert network.seconds(kind, a, b) <= 1.01 / LIMITS[kind].speed / (
                1 - LIMITS[kind].slowing)
    points = network.raster.points()[::5, ::5]
    for kind in LIMITS:
        stands = passable(site, points, LIMITS[kind])
        assert not (np.isfinite(network.slowness(kind)[::5, ::5]) & ~stands).any()


def test_closing_ground_lengthens_ways_and_renews_only_what_changes(monkeypatch):
    solved = []
    monkeypatch.setattr(roads, "solve", lambda *a: solved.append("new") or field.solve(*a))
    monkeypatch.setattr(roads, "renew", lambda *a: solved.append("again") or field.renew(*a))
    before = walled()
    start, near, far = (-8.0, 4.0), (-8.0, -4.0), (8.0, 4.0)
    first = before.matrix("robot", [start], [near, far])
    assert solved == ["new", "new"]
    before.matrix("robot", [near, far], [near, far])
    before.way("robot", near, far)
    assert len(solved) == 2  # what is known is not solved again
    after = before.close("robot", (0.0, 4.3), 0.3)
    assert len(solved) == 2
    second = after.matrix("robot", [start], [near, far])
    assert solved[2:] == ["again", "again"]
    assert second[0, 0] == pytest.approx(first[0, 0])
    assert first[0, 1] < second[0, 1] < 1.2 * first[0, 1]
    assert before.seconds("robot", start, far) == first[0, 1]
    fresh = Roads.of_slowness(after.raster, {"robot": after.slowness("robot")})
    for to in (near, far):
        np.testing.assert_allclose(after.field("robot", to), fresh.field("robot", to), rtol=1e-12)
    shut = after.close("robot", (0.0, 3.5), 1.0)
    assert np.isinf(shut.seconds("robot", start, far))
    assert np.isfinite(shut.seconds("robot", start, near))
    with pytest.raises(InputError, match="no way for a robot robot from"):
        shut.way("robot", start, far)


@pytest.mark.parametrize("seed", range(4))
def test_renewed_fields_are_those_made_anew(seed):
    rng = np.random.default_rng(seed)
    network = Roads.over(make_site("highland", 3, 32.0), (24, 24), 1.0,
                         {"rover": LIMITS["wheeled"]})
    targets = rng.uniform(-11, 11, (4, 2))
    for _ in range(3):
        for to in targets:
            network.field("rover", to)
        network = network.close_cell("rover", tuple(rng.integers(0, 24, 2)))
        network = network.close("rover", rng.uniform(-12, 12, 2))
    fresh = Roads.of_slowness(network.raster, {"rover": network.slowness("rover")})
    for to in targets:
        np.testing.assert_allclose(network.field("rover", to), fresh.field("rover", to),
                                   rtol=1e-12)


def test_who_stands_on_closed_ground_may_leave_it_but_nobody_enters():
    network = walled()
    inside = (0.0, -2.0)
    assert not network.passable("robot", inside)
    assert np.isinf(network.seconds("robot", (-5.0, -2.0), inside))
    out = network.seconds("robot", inside, (-5.0, -2.0))
    assert 5.0 < out < 6.0
    way = network.way("robot", inside, (-5.0, -2.0))
    assert way.seconds == pytest.approx(out, rel=0.05)
    assert network.passable("robot", way.points[1])
    assert network.seconds("robot", inside, inside) == 0.0
    assert network.way("robot", inside, inside).seconds == 0.0


def test_off_the_map_is_said():
    network = on_open_ground()
    assert network.seconds("robot", (16.4, 0.0), (0.0, 0.0)) == pytest.approx(32.0, rel=0.01)
    for call in (lambda: network.seconds("robot", (0, 0), (17, 0)),
                 lambda: network.way("robot", (0, -40), (0, 0)),
                 lambda: network.passable("robot", (np.nan, 0)),
                 lambda: network.close("robot", (99, 0))):
        with pytest.raises(InputError, match="off the map, which reaches 16 m"):
            call()
    with pytest.raises(InputError, match="no roads for 'mule'; there are for robot"):
        network.seconds("mule", (0, 0), (1, 1))


def test_a_raster_is_made_once_for_a_site():
    site = make_site("flat", 0, 16.0)
    raster = Raster((8, 8), 1.0)
    first = slowness(site, raster, LIMITS["wheeled"])
    assert slowness(site, Raster((8, 8), 1.0), LIMITS["wheeled"]) is first
    assert slowness(make_site("flat", 0, 16.0), raster, LIMITS["wheeled"]) is not first
    assert not first.flags.writeable


@pytest.mark.parametrize("cell_m", [0.25, 0.4, 1.0, 1.3, 2.0])
def test_points_stand_on_centres_of_cells(cell_m):
    raster = Raster((3, 5), cell_m)
    points = raster.points()
    assert points.shape == (*raster.shape, 2)
    assert raster.spacing <= 0.25 + 1e-12
    network = Roads.of_slowness(raster, {"robot": np.ones(raster.shape)})
    for cell in ((0, 0), (2, 4), (1, 2)):
        away = np.linalg.norm(points - network.centre(cell), axis=-1)
        assert away.min() == pytest.approx(0.0, abs=1e-9)


def test_who_weighs_the_dark_goes_round_it_and_is_told_true_seconds():
    raster = Raster((24, 24), 1.0)
    slow = np.full(raster.shape, 2.0)
    x, y = np.moveaxis(raster.points(), -1, 0)
    weight = np.where((np.abs(x) < 3) & (y < 5), 6.0, 1.0)  # dark, but for the north
    network = Roads.of_slowness(raster, {"rover": slow, "other": slow}, {"rover": weight})
    start, to = (-8.0, -4.0), (8.0, -4.0)
    straight = network.way("other", start, to)
    assert straight.metres == pytest.approx(16.0)
    round_it = network.way("rover", start, to)
    assert max(round_it.points[:, 1]) > 4.7
    assert round_it.seconds == pytest.approx(2.0 * round_it.metres, rel=1e-6)
    assert round_it.seconds < 2.0 * 1.1 * 2 * np.hypot(8, 9)
    told = network.matrix("rover", [start, to], [to, start, (0.0, 0.0)])
    assert told.shape == (2, 3)
    assert told[0, 0] == pytest.approx(round_it.seconds)
    assert told[0, 2] == pytest.approx(2.0 * np.hypot(8, 4), rel=0.05)  # into the dark: straight
    np.testing.assert_allclose(network.slowness("rover"), slow)
    shut = network.close("rover", (0.0, 8.0), half=2.8)
    assert shut.seconds("rover", start, to) > round_it.seconds
