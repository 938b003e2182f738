"""Where the bundled assets are: inside the wheel, else in the checkout."""

from pathlib import Path

from moonteam.errors import InputError


def assets() -> Path:
    """The folder of bundled robots, missions, policies and test sets."""
    package = Path(__file__).resolve().parent
    for folder in (package / "assets", package.parent.parent / "assets"):
        if folder.is_dir():
            return folder
    raise FileNotFoundError("moonteam's assets folder is missing: the installation is broken")


def find(name: str, folder: str, suffix: str) -> Path:
    """A user's file, else the bundled asset of that name (``demo`` for missions/demo.yaml)."""
    path = Path(name)
    if path.exists():
        return path
    if path.suffix == suffix and path.parent != Path():
        raise InputError(name, "no such file")
    bundled = assets() / folder / (name if name.endswith(suffix) else name + suffix)
    if bundled.is_file():
        return bundled
    names = sorted(p.stem for p in (assets() / folder).glob(f"*{suffix}"))
    raise InputError(name, f"no such file, nor one of the bundled {folder}: {', '.join(names)}")
