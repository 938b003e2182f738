"""What moonteam needs to run, by name, version and licence, as the installed packages say it."""

from __future__ import annotations

import re
from importlib import metadata
from typing import NamedTuple

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


class Package(NamedTuple):
    """An installed package."""

    name: str
    version: str
    licence: str


def packages(root: str = "moonteam") -> list[Package]:
    """`root` and all that it needs to run, in order of name; extras are left out."""
    found: dict[str, Package] = {}
    way: list[tuple[str, str]] = [(root, "")]
    seen = set()
    while way:
        one = way.pop()
        if one in seen:
            continue
        seen.add(one)
        name, extra = one
        held = metadata.distribution(name)
        found[name] = Package(name, held.version, licence(held))
        for line in held.requires or ():
            needed = Requirement(line)
            if needed.marker is None or needed.marker.evaluate({"extra": extra}):
                other = canonicalize_name(needed.name)
                way += [(other, ""), *((other, extra) for extra in needed.extras)]
    return [found[name] for name in sorted(found)]


def licence(held: metadata.Distribution) -> str:
    """As an expression, in a few words, or by its class; empty if it does not say."""
    said = held.metadata
    if said["License-Expression"]:
        return said["License-Expression"]
    lines = (said["License"] or "").strip().splitlines()
    if len(lines) == 1 and len(lines[0]) < 60 and lines[0] != "UNKNOWN":
        return lines[0]
    classes = [line.split(" :: ")[-1] for line in said.get_all("Classifier") or ()
               if line.startswith("License :: ")]
    text = re.sub(r"\W+", " ", lines[0]).strip() if lines else ""
    return ", ".join(classes) or text[:60]
