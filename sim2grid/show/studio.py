"""Makes a film in processes of its own, so that whoever asked for it can go on.

Each process draws every so many-th picture and writes it to its standard output; a thread here
hands them on to ffmpeg in order. What is sent to a process is pickled, by and to ourselves alone.
"""

from __future__ import annotations

import dataclasses
import os
import pickle
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO

import numpy as np

from moonteam import interrupts
from moonteam.compilation import cores
from moonteam.report import video
from sim2grid.show.film import Film
from sim2grid.show.take import Style, Take

MOST_PROCESSES = 4
CRF = 22
POLL_S = 0.25


@dataclasses.dataclass(frozen=True)
class Cost:
    """What a film took. `cpu_s` counts the processes that drew it, not ffmpeg."""

    frames: int
    seconds: float  # of film
    cpu_s: float
    wall_s: float  # until it was whole, whenever it was asked for

    def timing(self) -> dict[str, float]:
        """As timing.json holds it."""
        return {f"film_{key}": round(value, 3)
                for key, value in dataclasses.asdict(self).items()}


class Shooting:
    """A film that is being made. Begins at once; `wait` until it is there, or `stop` it.

    As a context manager it is stopped at the end, unless it is there.
    """

    def __init__(self, take: Take, style: Style, path: Path, processes: int = 0):
        self.path, self.done = path, 0
        self.num_frames = Film(take, style).num_frames
        self._style = style
        self._begun, self._wall_s = time.perf_counter(), 0.0
        self._error: BaseException | None = None
        count = processes or min(cores(), MOST_PROCESSES, self.num_frames)
        self._crew: list[_Drawing] = []
        try:
            for index in range(count):
                self._crew.append(_Drawing(index, count))
        except BaseException:
            self.stop()
            raise
        self._thread = threading.Thread(target=self._collect, args=(take,), name="film",
                                        daemon=True)
        self._thread.start()

    @property
    def whole(self) -> bool:
        """Whether the film is there."""
        return not self._thread.is_alive() and self._error is None

    def wait(self, progress: Callable[[int], None] = lambda done: None) -> Cost:
        """Returns when the film is written whole; `progress(frames so far)` now and then.

        Raises InputError where it cannot be written. Stops the film if it is interrupted.
        """
        try:
            while self._thread.is_alive():
                self._thread.join(POLL_S)
                progress(self.done)
        except BaseException:
            self.stop()
            raise
        progress(self.done)
        if self._error is not None:
            raise self._error
        return Cost(self.num_frames, self.num_frames / self._style.fps,
                    sum(drawing.cpu_s for drawing in self._crew), self._wall_s)

    def stop(self) -> None:
        """Ends the processes; nothing is left of a film that was not there yet."""
        for drawing in self._crew:
            drawing.kill()
        thread = getattr(self, "_thread", None)
        if thread is not None:
            thread.join()

    def __enter__(self) -> Shooting:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def _collect(self, take: Take) -> None:
        width, height = self._style.size
        try:
            with interrupts.leaving(self.stop), ExitStack() as stack:
                for drawing in self._crew:
                    stack.callback(drawing.kill)
                for drawing in self._crew:  # which take it once they have begun
                    drawing.send(take, self._style)
                add = stack.enter_context(video.writing(
                    self.path, (height, width), self._style.fps, CRF, preset="veryfast"))
                for number in range(self.num_frames):
                    add(self._crew[number % len(self._crew)].picture(width, height))
                    self.done = number + 1
                for drawing in self._crew:
                    drawing.finish()
            self._wall_s = time.perf_counter() - self._begun
        except BaseException as error:  # told to whoever waits
            self._error = error


class _Drawing:
    """One process that draws."""

    def __init__(self, index: int, count: int):
        self.cpu_s = 0.0
        # One thread each: Mesa's and NumPy's own would only get into each other's way.
        alone = {"LP_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"} if count > 1 else {}
        paths = os.pathsep.join(path for path in sys.path if path)
        environment = os.environ | alone | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": paths}
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "sim2grid.show.studio", str(index), str(count)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._said, env=environment)

    def send(self, take: Take, style: Style) -> None:
        """Says what is to be drawn."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # it has ended, and says why when it is asked
            pickle.dump((take, style), self._process.stdin, pickle.HIGHEST_PROTOCOL)
            self._process.stdin.close()

    def picture(self, width: int, height: int) -> video.Picture:
        """[height, width, 3]: its next picture."""
        return np.frombuffer(self._read(3 * width * height), np.uint8).reshape(height, width, 3)

    def finish(self) -> None:
        """Takes down what it cost."""
        self.cpu_s = float(np.frombuffer(self._read(8), np.float64)[0])

    def kill(self) -> None:
        """Ends it; harmless twice."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with suppress(OSError):
                    stream.close()
        self._said.close()

    def _read(self, count: int) -> bytes:
        assert self._process.stdout is not None
        data = self._process.stdout.read(count)
        if len(data) < count:
            code = self._process.wait()
            if self._said.closed:
                raise RuntimeError("the film was stopped")
            self._said.seek(0)
            lines = self._said.read().decode(errors="replace").strip().splitlines()
            raise RuntimeError(f"a process that drew the film ended with exit code {code}: "
                               + (lines[-1] if lines else "nothing was said"))
        return data


def draw(take: Take, style: Style, index: int, count: int, out: IO[bytes]) -> None:
    """Writes picture `index` and every `count`-th after it, then what that cost, 8 bytes."""
    film = Film(take, style)
    views = None
    if take.model is not None and style.layout != "map":
        from sim2grid.show.views import SceneViews

        views = film.views = SceneViews(film)
    try:
        for number in range(index, film.num_frames, count):
            out.write(film.picture(number).tobytes())
    finally:
        if views is not None:
            views.shut()
    used = resource.getrusage(resource.RUSAGE_SELF)
    out.write(np.float64(used.ru_utime + used.ru_stime).tobytes())
    out.flush()


def main() -> None:
    """`python -m sim2grid.show.studio INDEX COUNT`, as `Shooting` starts it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever started it ends it
    index, count = (int(word) for word in sys.argv[1:])
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # nothing else comes between the pictures
    take, style = pickle.load(sys.stdin.buffer)
    with suppress(BrokenPipeError):
        draw(take, style, index, count, out)


if __name__ == "__main__":
    main()
