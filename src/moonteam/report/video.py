"""Films: pictures one by one to ffmpeg, which comes with the package imageio-ffmpeg."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt

from moonteam import files
from moonteam.errors import InputError

Picture = npt.NDArray[np.uint8]  # [height, width, 3]


@contextmanager
def writing(path: str | os.PathLike[str], size: tuple[int, int], fps: float, crf: int,
            preset: str = "medium") -> Iterator[Callable[[Picture], None]]:
    """Writes a film as h264, whole or not at all; yields what takes the next picture.

    Args:
      path: of the film (.mp4).
      size: (height, width) px, both even.
      fps: pictures a second.
      crf: ffmpeg's constant rate factor; less is finer.
      preset: of x264; a faster one takes less time and makes a larger file.

    Raises InputError saying why it cannot be written.
    """
    import imageio_ffmpeg

    height, width = size
    words = ["-v", "error", "-f", "rawvideo", "-vcodec", "rawvideo", "-pix_fmt", "rgb24",
             "-s", f"{width}x{height}", "-r", f"{fps}", "-i", "-", "-an", "-vcodec", "h264",
             "-pix_fmt", "yuv420p", "-vb", "0", "-crf", f"{crf}", "-preset", preset,
             "-movflags", "+faststart", "-y"]
    with files.replacing(path) as temporary, tempfile.TemporaryFile() as said:
        process = subprocess.Popen([imageio_ffmpeg.get_ffmpeg_exe(), *words, temporary],
                                   stdin=subprocess.PIPE, stderr=said)
        assert process.stdin is not None
        stdin = process.stdin

        @contextmanager
        def telling() -> Iterator[None]:
            try:
                yield
            except BrokenPipeError:  # it has ended
                raise _unwritten(path, process, said) from None

        def add(picture: Picture) -> None:
            with telling():
                stdin.write(np.ascontiguousarray(picture).data)

        try:
            yield add
            with telling():
                stdin.close()
            if process.wait():
                raise _unwritten(path, process, said)
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
            with suppress(BrokenPipeError):
                stdin.close()


def for_readme(film: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Writes a film again as a moving picture that pages show: by the ending, .webp or .gif.

    Smaller and with fewer pictures a second. Raises InputError saying why it cannot be written.
    """
    import imageio_ffmpeg

    small = "fps={},scale={}:-2:flags=lanczos"
    if Path(path).suffix == ".gif":
        words = ["-vf", small.format(10, 480) + ",split[a][b];[a]palettegen=max_colors=96[p];"
                 "[b][p]paletteuse=dither=bayer:bayer_scale=4", "-f", "gif"]
    else:
        words = ["-vf", small.format(12, 720), "-c:v", "libwebp", "-quality", "50",
                 "-compression_level", "4", "-f", "webp"]
    with files.replacing(path) as temporary, tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", film, *words, "-loop", "0", "-y",
             temporary], stdin=subprocess.DEVNULL, stderr=said)
        if process.wait():
            raise _unwritten(path, process, said)


def _unwritten(path: str | os.PathLike[str], process: subprocess.Popen[bytes], said: IO[bytes]
               ) -> InputError:
    """What ffmpeg said last of its file, or how it ended."""
    code = process.wait()
    said.seek(0)
    lines = said.read().decode(errors="replace").splitlines()
    full = [line for line in lines if "space left" in line or "too large" in line]
    why = next(iter(full or lines), "") or (
        signal.strsignal(-code) if code < 0 else f"exit code {code}")
    return InputError(path, f"cannot be written: ffmpeg: {why}".replace(
        str(Path(path).parent), "."))
