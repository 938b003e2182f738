"""A robot that is not there yet: a sled on four balls with one thruster that pushes it along."""

from types import SimpleNamespace

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from moonteam.robots.base import RobotKind, Telemetry

MASS = 4.0
PUSH = 6.0  # N at full throttle

SLED = f"""
<mujoco model="sled">
  <worldbody>
    <body name="sled">
      <freejoint/>
      <geom name="deck" type="box" size=".3 .2 .04" mass="{MASS}" contype="0" conaffinity="0"/>
      <geom name="hull" type="sphere" size=".2" mass="0" contype="2" conaffinity="2"/>
      <geom name="a" type="sphere" size=".06" pos=".25 .15 -.1" mass="0"
            contype="0" conaffinity="1"/>
      <geom name="b" type="sphere" size=".06" pos=".25 -.15 -.1" mass="0"
            contype="0" conaffinity="1"/>
      <geom name="c" type="sphere" size=".06" pos="-.25 .15 -.1" mass="0"
            contype="0" conaffinity="1"/>
      <geom name="d" type="sphere" size=".06" pos="-.25 -.15 -.1" mass="0"
            contype="0" conaffinity="1"/>
      <site name="jet"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="jet" site="jet" gear="1 0 0 0 0 0" ctrllimited="true" ctrlrange="0 {PUSH}"/>
  </actuator>
</mujoco>
"""


def load(xml: str = SLED) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(xml)


def init(qpos, qvel):
    return jnp.zeros(())


def control(state, time, qpos, qvel, command, surface):
    """Throttle by the command's speed; counts its own calls."""
    push = jnp.where(command.lost, 0.0, jnp.clip(command.speed, 0.0, 1.0) * PUSH)
    told = Telemetry(push * jnp.abs(qvel[0]), push / 1000.0)
    return push[None], state + 1.0, told


SLED_KIND = RobotKind(
    name="sled", load=load, base="sled", spawn_height=0.16, home=np.zeros(0), speed=1.0,
    footprint=0.35, max_slope=0.5, init=init, control=control)


@pytest.fixture(scope="session")
def sled() -> SimpleNamespace:
    """The sled: its kind, its XML, how to load another XML, its mass kg and push N."""
    return SimpleNamespace(kind=SLED_KIND, xml=SLED, load=load, mass=MASS, push=PUSH)
