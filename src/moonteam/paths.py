"""Where the bundled assets are: inside the wheel, else in the checkout."""

from pathlib import Path

from moonteam.errors import InputError, meant


def assets() -> Path:
    """The folder of bundled robots, missions, policies and test sets."""
    package = Path(__file__).resolve().parent
    for folder in (package / "assets", package.parent.parent / "assets"):
        if folder.is_dir():
            return folder
    raise FileNotFoundError("moonteam's assets folder is missing: the installation is broken")


def find(name: str, folder: str, suffix: str) -> Path:
    """A user's file, else the bundled asset of that name (``demo`` for missions/demo.yaml).

    A folder of that name is no file. Raises InputError.
    """
    path = Path(name)
    if path.exists() and not path.is_dir():
        return path
    if path.suffix == suffix and path.parent != Path():
        raise InputError(name, "is a folder" if path.is_dir() else "no such file")
    bundled = assets() / folder / (name if name.endswith(suffix) else name + suffix)
    if bundled.is_file():
        return bundled
    names = bundled_names(folder, suffix)
    what = "is a folder" if path.is_dir() else "no such file"
    raise InputError(name, f"{what}; {meant(path.stem, names)}bundled {folder}: "
                     + ", ".join(names))


def bundled_names(folder: str, suffix: str) -> list[str]:
    """Of the bundled assets of one kind, by which `find` knows them."""
    top = assets() / folder
    return sorted(p.relative_to(top).with_suffix("").as_posix() for p in top.rglob(f"*{suffix}"))
