import pytest


@pytest.fixture(scope="session")
def jaxmarl():
    """JaxMARL's modules; importing them prints, which is not wanted where nobody asks."""
    import jaxmarl.environments.multi_agent_env as base
    import jaxmarl.environments.spaces as spaces
    import jaxmarl.wrappers.baselines as wrappers
    return {"base": base, "spaces": spaces, "wrappers": wrappers}
