"""The film: its pictures, its words, and that it can be read back; nothing is rendered."""

import subprocess

import imageio_ffmpeg
import msgspec
import numpy as np
import pytest
from PIL import Image

from moonteam.errors import InputError
from moonteam.problem.sun import SunPosition
from moonteam.report import video
from moonteam.terrain.site import Site, make_site
from sim2grid.frame import Frame
from sim2grid.show.film import Film, Seen
from sim2grid.show.hud import Label, Labels
from sim2grid.show.picture import (
    Ground,
    MapPicture,
    RobotMark,
    TargetMark,
    hillshade,
    requirement,
)
from sim2grid.show.studio import Shooting
from sim2grid.show.take import Actor, Style, Take, planned_ways

SMALL = Style(size=(320, 180), fps=10, seconds=2.0)


def take_of(spec, record, bases, side=4):
    ground = Ground(np.add.outer(np.arange(33.0), np.zeros(33)) * 0.01, side / 16)
    return Take(spec, record, Frame((side, side), 1.0), ground, "test",
                tuple(Actor(base, "disc") for base in bases))


@pytest.fixture
def short_take(mission, execute, script):
    spec = mission(["a drone A 0 0", "b wheeled B 3 3"], ["A OR 1 0", "B OR 3 2"])
    return take_of(spec, execute(spec, script("right stay", "stay down")).record, [0, 7])


def test_moments_tell_what_was_going_on(short_take):
    film = Film(short_take)
    start = film.moment(0.0)
    assert start.status == ("moving", "waiting")
    assert start.decision == 1
    assert not start.solved
    np.testing.assert_allclose(start.ways[0], [[-1.5, -1.5], [-0.5, -1.5]], atol=0.05)
    assert len(start.ways[1]) == 1, "b means to stay"
    end = film.moment(1e9)
    assert end.solved == {0, 1}
    assert end.time_s == short_take.record.seconds()
    np.testing.assert_allclose(end.goals[1], [1.5, 0.5])


def test_poses_between_the_logged_ones_lie_between_them(short_take):
    film = Film(short_take)
    before, after = film.times[10], film.times[11]
    pose = film.pose((before + after) / 2)
    np.testing.assert_allclose(pose, (film.qpos[10] + film.qpos[11]) / 2, atol=1e-6)
    np.testing.assert_allclose(film.pose(1e9), film.qpos[-1], atol=1e-6)


def test_the_film_is_drawn_by_other_processes_and_has_its_pictures(short_take, tmp_path):
    shooting = Shooting(short_take, SMALL, tmp_path / "map.mp4", processes=2)
    seen = []
    cost = shooting.wait(seen.append)
    assert cost.frames == shooting.num_frames == Film(short_take, SMALL).num_frames
    assert cost.cpu_s > 0
    assert shooting.whole
    assert shooting.wait() == cost, "whenever it is asked"
    assert seen[-1] == cost.frames
    assert set(cost.timing()) == {"film_frames", "film_seconds", "film_cpu_s", "film_wall_s"}
    read = subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-i", tmp_path / "map.mp4", "-f", "rawvideo",
         "-pix_fmt", "rgb24", "-"], capture_output=True, check=True)
    assert b"h264" in read.stderr
    assert b"10 fps" in read.stderr
    pictures = np.frombuffer(read.stdout, np.uint8).reshape(-1, 180, 320, 3)
    assert len(pictures) == cost.frames
    own = Film(short_take, SMALL).picture(9)
    assert np.abs(pictures[9].astype(int) - own).mean() < 6, "in order"
    for kind, magic in (("webp", b"WEBP"), ("gif", b"GIF8")):
        video.for_readme(tmp_path / "map.mp4", tmp_path / f"map.{kind}")
        assert magic in (tmp_path / f"map.{kind}").read_bytes()[:16]
    with pytest.raises(InputError, match="cannot be written"):
        video.for_readme(tmp_path / "none.mp4", tmp_path / "none.webp")
    assert not list(tmp_path.glob("none*"))


def test_a_film_that_is_stopped_leaves_nothing(short_take, tmp_path):
    shooting = Shooting(short_take, SMALL, tmp_path / "map.mp4", processes=1)

    def interrupt(done):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        shooting.wait(interrupt)
    assert list(tmp_path.iterdir()) == []


def test_the_cards_say_the_planner_and_the_optimum(short_take):
    from dataclasses import replace

    film = Film(replace(short_take, title="two: exact", optimum=("proved optimum: 2 decisions",)))
    title = [line for line, _, _ in film.title_lines()]
    assert title[0] == "two: exact"
    assert "2 robots, 2 targets, 4 x 4 m" in title
    end = [line for line, _, _ in film.end_lines()]
    assert end[0] == "Mission complete"
    assert end[1].startswith("2 of 2 targets in ")
    assert "proved optimum: 2 decisions" in end
    late = msgspec.structs.replace(film.mission, targets=film.mission.targets[:1])
    for mission, said in (film.mission, False), (late, True):
        lines = Film(replace(film.take, mission=mission)).end_lines()
        assert ("both for what was known at the start" in [line for line, _, _ in lines]) is said


def test_a_square_picture_has_room_for_the_map_alone(short_take):
    film = Film(short_take, Style(size=(160, 160), fps=10, seconds=2.0))
    assert film.picture(film.num_frames // 2).shape == (160, 160, 3)


def test_planned_ways_leave_out_who_stays():
    cells = np.array([[[0, 0], [3, 3]], [[1, 0], [3, 3]], [[1, 0], [3, 2]]])
    first, second = planned_ways(cells, Frame((4, 4), 1.0))
    np.testing.assert_allclose(first, [[-1.5, -1.5], [-0.5, -1.5]])
    np.testing.assert_allclose(second, [[1.5, 1.5], [1.5, 0.5]])


def test_the_map_puts_north_up_and_colours_targets_by_state(mission):
    spec = mission(["a drone A 0 0"], ["A OR 3 3", "A OR 0 3"])
    picture = MapPicture(Frame((4, 4), 1.0), Ground(np.zeros((17, 17)), 0.25), 400)
    marks = [TargetMark("far", spec.targets[0], True), TargetMark("near", spec.targets[1], False)]
    robots = [RobotMark("a", "triangle", np.array([[-1.5, -1.5]]))]
    wished = [np.array([[-1.5, -1.5], [1.5, -1.5]])]
    image = np.asarray(picture.draw(robots, marks, labels=False, wished=wished)).astype(int)
    top_right, top_left = image[:100, 300:], image[:100, :100]
    assert (top_right[..., 1] - top_right[..., 0]).max() > 100, "green: solved"
    assert (top_left[..., 0] - top_left[..., 1]).max() > 100, "red: open"
    lower_left = image[300:, :100]
    assert (lower_left[..., 2] - lower_left[..., 0]).max() > 100, "the robot's blue"
    between = image[345:355, 120:300]
    blue = (between[..., 2] - between[..., 0] > 60).any(axis=0)
    assert 0.3 < blue.mean() < 0.8, "where it means to go is dashed"


def test_the_map_is_dark_where_nobody_has_looked():
    picture = MapPicture(Frame((10, 10), 1.0), Ground(np.zeros((41, 41)), 0.25), 400)
    way = np.array([[-4.0, 0.0], [0.0, 0.0]])
    plain, looked = (np.asarray(picture.draw([RobotMark("a", "triangle", way, False, eyes)], (),
                                             labels=False)).astype(int) for eyes in (None, 2.0))
    x, y = np.meshgrid(np.arange(400) / 40 - 5.0, 5.0 - np.arange(400) / 40)
    gap = np.hypot(np.maximum(np.maximum(-4.0 - x, x), 0.0), y)
    assert (looked[gap < 1.9] == plain[gap < 1.9]).all()
    assert (looked[gap > 2.1].mean() < 0.7 * plain[gap > 2.1].mean())


def test_skills_with_names_stand_apart(mission):
    import msgspec

    spec = mission(["a drone A 0 0", "b legged AB 1 1"], ["AB AND 1 0", "AB OR 2 2"])
    target = spec.targets[0]
    assert (requirement(target), requirement(spec.targets[1])) == ("A+B", "A/B")
    named = msgspec.structs.replace(target, skills=("camera", "radio"))
    assert requirement(named) == "camera + radio"
    two = msgspec.structs.replace(target, skills=(), coalition={"A": 2, "B": 1})
    assert requirement(two) == "2 A + B"


def test_hillshade_lights_slopes_that_face_north_west():
    x, y = np.meshgrid(np.arange(20.0), np.arange(20.0))
    facing = hillshade(Ground(0.3 * (x - y), 1.0))[10, 10]
    averted = hillshade(Ground(0.3 * (y - x), 1.0))[10, 10]
    assert facing > averted + 50


def test_labels_lie_over_nothing():
    image = Image.new("RGB", (640, 360), (60, 60, 60))
    labels = Labels((640, 360), [(0, 0, 200, 60)], [(0, 0, 200, 60)], 16)
    at = [(300, 200), (302, 203), (305, 199), (100, 30), (320, 350), (636, 100), (900, 100)]
    drawn = labels.draw(image, [Label(np.array(p, float), f"name {k}", (255, 0, 0), "A+B")
                                for k, p in enumerate(at)])
    assert drawn == 5, "one lies behind the list, one out of the picture"
    for k, a in enumerate(labels.taken):
        assert a[0] >= 0
        assert a[2] <= 640
        for b in labels.taken[k + 1:]:
            assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]


class Plain:
    """Views without OpenGL: one colour."""

    def seen(self, shot, share, moment, qpos):
        return Seen(np.full((720, 1280, 3), 60, np.uint8), [], [])


@pytest.mark.parametrize("robots", [1, 3, 8])
def test_every_robot_has_its_place_in_the_strip_and_every_target_in_the_list(
        mission, execute, script, robots):
    kinds = ("drone", "legged", "wheeled")
    spec = mission([f"r{i} {kinds[i % 3]} A {i} 0" for i in range(robots)],
                   [f"A OR {i % 8} {1 + i // 8}" for i in range(16)], size=(8, 8), max_steps=1)
    done = execute(spec, script(" ".join(["up"] * robots)))
    film = Film(take_of(spec, done.record, range(0, 7 * robots, 7), 8), views=Plain())
    boxes = film._strip(Image.new("RGB", (1280, 720)), film.moment(0.5))
    assert len(boxes) == robots
    assert boxes[-1][2] <= 1280
    end = film._target_list(Image.new("RGB", (1280, 720)), film.moment(0.5), (1030, 260))
    assert end <= boxes[0][1], "the list ends above the strip"
    middle = film.shots[1]
    assert film.picture(film.shots[0].frames + middle.frames // 2).std() > 4


def test_the_map_is_darker_where_the_sun_does_not_reach():
    heights = np.zeros((41, 81), np.float32)
    heights[:, 60] = 1.0
    site = Site("wall", 0, heights, 0.25, sun=SunPosition(np.radians(90), np.radians(20)))
    shade = hillshade(Ground.of(site)).astype(float)
    # To the west: in shadow, in light for a panel 0.3 m up, in light. The wall is 1 m high.
    dark, half, bright = shade[20, 60 - 6], shade[20, 60 - 9], shade[20, 60 - 16]
    assert dark < 0.7 * half < 0.7 * bright
    assert Ground.of(make_site("flat", 0, 8.0)).light is None
