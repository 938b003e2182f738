# MuJoCo's names come from C extensions without stubs; this says so once for the type checker.
from typing import Any

def __getattr__(name: str) -> Any: ...
