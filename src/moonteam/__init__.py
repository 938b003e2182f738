"""moonteam plans for a team of unlike robots on the Moon and proves the plan in physics."""

__version__ = "0.1.0"
__all__ = ["__version__"]
