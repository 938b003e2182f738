"""What every test shares: strict JAX, and what was compiled once is kept."""

import contextlib
import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Commands that train make each core a device; which test asks first must not matter.
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "1")

import jax
import pytest

from moonteam.compilation import enable_cache, forget

jax.config.update("jax_numpy_rank_promotion", "raise")
enable_cache()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


MAPS = 20_000
"""Of Linux' 65,530 for a process, after which what is compiled is dropped: ten or so are a
program's, and XLA aborts when there are no more.
"""


@pytest.fixture(scope="module", autouse=True)
def room_for_programs():
    """Drops compiled programs after a file of tests, where there are many."""
    yield
    with contextlib.suppress(OSError), open("/proc/self/maps", encoding="ascii") as maps:
        if sum(1 for _ in maps) > MAPS:
            forget()


@pytest.fixture(scope="session")
def jaxmarl():
    """JaxMARL's modules; importing them prints, which is not wanted where nobody asks."""
    import jaxmarl.environments.multi_agent_env as base
    import jaxmarl.environments.spaces as spaces
    import jaxmarl.wrappers.baselines as wrappers
    return {"base": base, "spaces": spaces, "wrappers": wrappers}


@pytest.fixture(scope="session")
def pointing(tmp_path_factory):
    """A policy file of kind pointer with random weights: it solves everything, in a poor order."""
    from dataclasses import asdict

    from moonteam.policies import pointer
    from moonteam.policies.policy_file import PolicyFile, save_policy

    spec = pointer.PointerSpec(width=8, heads=2, layers=1, pairs=4)
    params = jax.device_get(jax.jit(lambda key: pointer.init(spec, key))(jax.random.key(2)))
    path = tmp_path_factory.mktemp("policy") / "pointing.safetensors"
    save_policy(path, PolicyFile("pointer", asdict(spec), params))
    return path


def pytest_collection_modifyitems(config, items):
    """What takes minutes is left out unless it is asked for: `make soak`."""
    if "soak" in config.getoption("markexpr"):
        return
    for item in items:
        if item.get_closest_marker("soak"):
            item.add_marker(pytest.mark.skip(reason="takes minutes: make soak"))
