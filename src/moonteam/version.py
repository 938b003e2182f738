"""The version, in one place: the wheel, reports and run folders take it from here."""

__version__ = "0.1.0"
