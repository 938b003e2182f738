"""The film: its length, its words, and that it can be read back; nothing is rendered."""

import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image, ImageDraw

from sim2grid.frame import Frame
from sim2grid.show import film as films
from sim2grid.show.film import FPS, HEIGHT, WIDTH, Film, playback, write
from sim2grid.show.picture import Ground, MapPicture, RobotMark, TargetMark, hillshade


@pytest.fixture
def short_film(mission, execute, script):
    spec = mission(["a drone A 0 0", "b wheeled B 3 3"], ["A OR 1 0", "B OR 3 2"])
    done = execute(spec, script("right stay", "stay down"))
    ground = Ground(np.add.outer(np.arange(33.0), np.zeros(33)) * 0.01, 0.25)
    return Film(spec, done.record, Frame((4, 4), 1.0), ground, [0, 7], "test")


@pytest.mark.parametrize(("seconds", "speed"), [(3.0, 0.25), (16.0, 1), (30.0, 2), (170.0, 10),
                                                 (1e4, 589)])
def test_playback_keeps_films_short(seconds, speed):
    assert playback(seconds) == speed
    assert seconds / playback(seconds) <= films.LONGEST_S


def test_a_film_lasts_ten_seconds_at_least_and_twenty_at_most(short_film):
    assert 10 <= short_film.num_frames / FPS <= 21


def test_moments_tell_what_was_going_on(short_film):
    start = short_film.moment(0.0)
    assert start.status == ("moving", "waiting")
    assert start.decision == 1
    assert not start.solved
    end = short_film.moment(1e9)
    assert end.solved == {0, 1}
    assert end.time_s == short_film.record.seconds()
    np.testing.assert_allclose(end.goals[1], [1.5, 0.5])


def test_the_film_is_written_and_has_its_frames(short_film, tmp_path, monkeypatch):
    monkeypatch.setattr(films, "SHORTEST_S", 0.0)
    monkeypatch.setattr(films, "HOLD_S", 0.2)
    short_film.speed = 8.0
    write(short_film, tmp_path / "map.mp4")
    read = subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-i", tmp_path / "map.mp4", "-f", "rawvideo",
         "-pix_fmt", "rgb24", "-"], capture_output=True, check=True)
    assert b"h264" in read.stderr
    assert f"{FPS} fps".encode() in read.stderr
    video = np.frombuffer(read.stdout, np.uint8).reshape(-1, HEIGHT, WIDTH, 3)
    assert video.shape == (short_film.num_frames, HEIGHT, WIDTH, 3)
    assert video[0].std() > 10, "not an empty picture"
    assert np.abs(video[0].astype(int) - video[-1]).max() > 60, "something changed"


def test_the_map_puts_north_up_and_colours_targets_by_state(mission):
    spec = mission(["a drone A 0 0"], ["A OR 3 3", "A OR 0 3"])
    picture = MapPicture(Frame((4, 4), 1.0), Ground(np.zeros((17, 17)), 0.25), 400)
    marks = [TargetMark("far", spec.targets[0], True), TargetMark("near", spec.targets[1], False)]
    robots = [RobotMark("a", "triangle", np.array([[-1.5, -1.5]]))]
    image = np.asarray(picture.draw(robots, marks, labels=False)).astype(int)
    top_right, top_left = image[:100, 300:], image[:100, :100]
    assert (top_right[..., 1] - top_right[..., 0]).max() > 100, "green: solved"
    assert (top_left[..., 0] - top_left[..., 1]).max() > 100, "red: open"
    lower_left = image[300:, :100]
    assert (lower_left[..., 2] - lower_left[..., 0]).max() > 100, "the robot's blue"


def test_hillshade_lights_slopes_that_face_north_west():
    x, y = np.meshgrid(np.arange(20.0), np.arange(20.0))
    facing = hillshade(0.3 * (x - y), 1.0)[10, 10]
    averted = hillshade(0.3 * (y - x), 1.0)[10, 10]
    assert facing > averted + 50


class Plain:
    """Views without OpenGL: one colour."""

    def main(self, moment, qpos):
        return np.full((HEIGHT, WIDTH, 3), 60, np.uint8)

    def close(self, moment, qpos, robot):
        return np.full((films.CLOSE[1], films.CLOSE[0], 3), 90, np.uint8)


@pytest.mark.parametrize("robots", [1, 3, 8])
def test_every_robot_has_its_place_in_the_strip_and_every_target_in_the_list(
        mission, execute, script, robots):
    kinds = ("drone", "legged", "wheeled")
    spec = mission([f"r{i} {kinds[i % 3]} A {i} 0" for i in range(robots)],
                   [f"A OR {i % 8} {1 + i // 8}" for i in range(16)], size=(8, 8), max_steps=1)
    done = execute(spec, script(" ".join(["up"] * robots)))
    ground = Ground(np.zeros((33, 33)), 0.25)
    film = Film(spec, done.record, Frame((8, 8), 1.0), ground, range(0, 7 * robots, 7), "test",
                views=Plain())
    picture = film.picture(1.0).astype(int)
    strip = picture[HEIGHT - films.CLOSE[1]:HEIGHT - 20]
    framed = (strip == 90).all(axis=(0, 2))  # columns that show nothing but a close view
    borders = np.count_nonzero(np.diff(framed.astype(int)) == 1)
    assert borders >= robots, "a close view a robot"
    pen = ImageDraw.Draw(Image.new("RGB", (WIDTH, HEIGHT)), "RGBA")
    end = film._target_list(pen, film.moment(1.0), (650, 208), films.FREE[3])
    assert end <= films.FREE[3], "the list ends above a strip that reaches under it"
