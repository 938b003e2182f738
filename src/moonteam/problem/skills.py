"""Skills as a person reads them: letters close together, names apart."""

from __future__ import annotations

from collections.abc import Collection


def held(skills: Collection[str]) -> str:
    """Those of a robot: AB; camera, radio."""
    return ("" if _letters(skills) else ", ").join(skills)


def needed(skills: Collection[str], either: bool) -> str:
    """Those that a target asks for, all of them or `either`: A+B, A/B; camera + radio."""
    sign = "/" if either else "+"
    return (sign if _letters(skills) else f" {sign} ").join(skills)


def _letters(skills: Collection[str]) -> bool:
    return all(len(skill) == 1 for skill in skills)
