"""What a report must say of where it was made, so that its figures can be made again."""

from __future__ import annotations

import importlib.metadata
import platform
import subprocess
from pathlib import Path

from moonteam.compilation import cores

PACKAGES = ("moonteam", "jax", "jaxlib", "numpy", "numba", "flax")


def commit() -> str | None:
    """The checkout's commit, with -dirty if code or assets differ; None in a wheel."""
    folder = Path(__file__).resolve().parents[1]
    top = git(folder, "rev-parse", "--show-toplevel")
    if top is None or not folder.is_relative_to(top) or folder != Path(top) / "src" / "moonteam":
        return None  # a wheel inside some other project's checkout
    found = git(folder, "rev-parse", "--short=12", "HEAD")
    parts = [str(Path(top) / name) for name in ("src", "training", "sim2grid", "assets")]
    changed = git(folder, "status", "--porcelain", "--untracked-files=no", "--", *parts)
    return f"{found}-dirty" if found and changed else found


def git(folder: Path, *words: str) -> str | None:
    """What git says in a folder; None where it knows nothing."""
    try:
        done = subprocess.run(["git", "-C", str(folder), *words], capture_output=True,
                              encoding="utf-8", errors="surrogateescape",
                              timeout=20, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def processor() -> str:
    """The processor's name."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def versions() -> dict[str, str]:
    """Installed versions of what the figures depend on."""
    return {name: importlib.metadata.version(name) for name in PACKAGES}


def meta(made_by: str, seed: int) -> dict:
    """Command, seed, commit, versions and machine."""
    import jax

    device = jax.devices()[0]
    return {
        "command": made_by,
        "seed": seed,
        "commit": commit(),
        "versions": {"python": platform.python_version(), **versions()},
        "hardware": {"processor": processor(), "cores": cores(),
                     "jax_device": f"{device.platform}: {device.device_kind}"},
    }


def hardware_line(document: dict) -> str:
    """One line for under a table."""
    machine, made = document["hardware"], document["versions"]
    device = machine["jax_device"]
    return (f"commit {document['commit'] or 'unknown'}, seed {document['seed']}, "
            f"{machine['cores']} cores of {machine['processor']}, JAX {made['jax']} on {device}")
