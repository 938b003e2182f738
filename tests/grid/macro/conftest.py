"""The instances of the planners by the clock, for the macro world."""

import importlib.util
import pathlib

import pytest


@pytest.fixture(scope="session")
def instances():
    path = pathlib.Path(__file__).parents[2] / "planners" / "seconds" / "instances.py"
    spec = importlib.util.spec_from_file_location("seconds_instances", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
