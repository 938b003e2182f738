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
