"""Instances for the tests of planners by the clock."""

import importlib.util
import pathlib

import pytest


@pytest.fixture(scope="session")
def instances():
    path = pathlib.Path(__file__).with_name("instances.py")
    spec = importlib.util.spec_from_file_location("seconds_instances", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def pytest_configure(config):
    config.addinivalue_line("markers", "soak: minutes long; run with -m soak")


def pytest_collection_modifyitems(config, items):
    if "soak" not in config.getoption("markexpr"):
        for item in items:
            if item.get_closest_marker("soak"):
                item.add_marker(pytest.mark.skip(reason="minutes long; run with -m soak"))
