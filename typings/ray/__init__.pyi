# Ray is an extra that need not be installed; this says so once for the type checker.
from typing import Any

def __getattr__(name: str) -> Any: ...
