"""`moonteam doctor`: what this machine can do, and what to install for the rest."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
import sys
from dataclasses import dataclass

from moonteam import compilation, files, paths
from moonteam.commands.options import Printed, Saved

FILES = ("doctor.json",)
"""In --out."""
PACKAGES = ("jax", "flax", "mujoco", "mujoco-mjx", "terraingenpy", "rasterio", "numba", "ortools")

RENDER_PROBE = """
import os, sys
os.environ.setdefault("MUJOCO_GL", "egl")
import mujoco
model = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><light pos="0 0 3"/><geom size="1"/></worldbody></mujoco>')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 48, 64)
renderer.update_scene(data)
drawn = renderer.render().max() > 0
print("" if drawn else "the picture is black", file=sys.stderr, flush=True)
os._exit(not drawn)
"""


@dataclass(frozen=True)
class Args(Saved, Printed):
    """Say what this machine can do: JAX devices, headless rendering, video, extras.

    Files in --out: doctor.json, which is what --json prints.

    Examples:
      moonteam doctor
      moonteam doctor --json
      moonteam doctor --out runs/doctor
      moonteam doctor --licences
    """

    licences: bool = False
    """Say instead what moonteam needs to run: name, version and licence of every package."""


def versions() -> dict[str, str | None]:
    """Installed version of each package that matters; None where it is missing."""
    found: dict[str, str | None] = {}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def rendering() -> tuple[bool, str]:
    """Whether a frame can be drawn without a screen; a process of its own, since GL may abort."""
    done = subprocess.run([sys.executable, "-c", RENDER_PROBE], capture_output=True,
                          encoding="utf-8", errors="replace", timeout=120, check=False)
    if done.returncode == 0:
        return True, "works (MUJOCO_GL=" + os.environ.get("MUJOCO_GL", "egl") + ")"
    last = (done.stderr.strip().splitlines() or ["no message"])[-1]
    return False, ("does not work; on Debian or Ubuntu: apt-get install libegl1 libgl1 "
                   f"libgl1-mesa-dri libglx-mesa0 ({last})")


def examine() -> dict:
    """Everything the command reports, as a JSON-able document."""
    drawn, how = rendering()
    try:
        import imageio_ffmpeg

        video: str | None = imageio_ffmpeg.get_ffmpeg_version()
    except (ImportError, RuntimeError):
        video = None
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cores": os.cpu_count(),
        "packages": versions(),
        "devices": [{"platform": d.platform, "kind": d.device_kind}
                    for d in compilation.devices()],
        "rendering": {"works": drawn, "note": how},
        "ffmpeg": video,
        "cache": str(compilation.cache_folder()),
        "assets": str(paths.assets()),
    }


def run(args: Args) -> int:
    """Prints the findings; always 0, since missing extras are no failure."""
    if args.licences:
        return _print_licences(args)
    found = examine()
    _save(args, found)
    if args.json:
        print(files.dump_json(found))
        return 0
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False, box=None)
    table.add_row("Python", found["python"] + " on " + found["platform"])
    table.add_row("cores", str(found["cores"]))
    for name, version in found["packages"].items():
        table.add_row(name, version or "not installed")
    for device in found["devices"]:
        table.add_row("JAX device", f"{device['platform']}: {device['kind']}")
    if not found["devices"]:
        asked = os.environ.get("JAX_PLATFORMS")
        table.add_row("JAX device", f"none of JAX_PLATFORMS={asked}; unset it, or set it to cpu")
    table.add_row("3-D rendering", found["rendering"]["note"])
    table.add_row("video", f"ffmpeg {found['ffmpeg']}" if found["ffmpeg"] else "no ffmpeg found")
    table.add_row("cache", found["cache"])
    Console().print(table)
    return 0


def _save(args: Args, found: object) -> None:
    if args.out is not None:
        files.write_json(args.out / FILES[0], found)


def _print_licences(args: Args) -> int:
    from moonteam.report import licences

    found = licences.packages()
    _save(args, [one._asdict() for one in found])
    if args.json:
        print(files.dump_json([one._asdict() for one in found]))
        return 0
    wide = max(len(f"{one.name} {one.version}") for one in found)
    for one in found:
        print(f"{one.name} {one.version}".ljust(wide), one.licence)
    return 0
