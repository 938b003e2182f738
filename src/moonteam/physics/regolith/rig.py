"""A wheel on a test bed, in C MuJoCo: free to sink and to go on, turned at a steady rate.

The forces are those of a scene (`forces.soil_forces`); the bed is level and gravity leans, as if it
were a slope.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from moonteam.physics.regolith.bed import Bed, bed_of
from moonteam.physics.regolith.forces import Memory, Told, fresh, soil_forces
from moonteam.physics.regolith.treads import Treads, felt_of, radii
from moonteam.physics.regolith.wheel import Shape
from moonteam.robots.base import CONTROL_PERIOD, PHYSICS_DT, Tread
from moonteam.terrain.soil import Soil
from moonteam.terrain.surface import Surface

SECONDS, SETTLED = 12.0, 6.0
"""How long a wheel turns, and from when on it is watched."""

RIG = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{dt}" integrator="implicitfast" cone="pyramidal" gravity="{along} 0 {down}"/>
  <worldbody>
    <geom name="ground" type="plane" size="50 5 1" condim="1" priority="1"/>
    <body name="carriage" pos="0 0 {radius}">
      <inertial pos="0 0 0" mass="{half}" diaginertia="1 1 1"/>
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
      <body name="wheel">
        <inertial pos="0 0 0" mass="{half}" diaginertia="{inertia} {inertia} {inertia}"/>
        <joint name="axle" type="hinge" axis="0 1 0"/>
        <geom name="rim" type="sphere" size="{radius}" mass="0"/>
        <site name="rim" size="{felt}"/>
      </body>
    </body>
  </worldbody>
  <actuator><velocity joint="axle" kv="{gain}"/></actuator>
  <sensor><touch site="rim"/></sensor>
</mujoco>
"""


def climb(shape: Shape, soil: Soil, mass: float, rate: float, slope: float, gravity: float
          ) -> tuple[float, float]:
    """Slip and sinkage m at which a wheel that carries `mass` kg and turns at `rate` rad/s climbs a
    `slope` rad; slip above 1: it slides back.
    """
    half = mass / 2.0
    model = mujoco.MjModel.from_xml_string(RIG.format(
        dt=PHYSICS_DT, along=-gravity * np.sin(slope), down=-gravity * np.cos(slope),
        radius=shape.tip, half=half, inertia=half * shape.tip**2 / 2.0, felt=1.4 * shape.tip,
        gain=200.0 * half * shape.tip**2))
    data = mujoco.MjData(model)
    wheel = model.body("wheel").id
    one = [np.array([i]) for i in (model.geom("rim").id, wheel, model.body("carriage").id, 0, 0)]
    treads = Treads(*one)
    bed = bed_of(soil, [Tread(shape.width, shape.grousers, True)], np.array([shape.tip]),
                 np.array([[0.0, 1.0, 0.0]]), np.array([mass * gravity]))
    step = jax.jit(partial(_step, bed, Surface(jnp.zeros((2, 2)), 100.0)))
    memory = fresh(1)
    begun, depth = np.zeros(3), []
    for tick in range(round(SECONDS / CONTROL_PERIOD)):
        forces, size, memory, told = step(memory, treads.felt(
            data, data.sensordata[treads.sensors], np).astype(np.float32))
        data.xfrc_applied[wheel] = forces[0]
        model.geom_size[treads.geoms[0], 0] = size[0]
        # It starts softly, as a hand would let it.
        data.ctrl[0] = rate * min(1.0, tick * CONTROL_PERIOD)
        mujoco.mj_step(model, data, round(CONTROL_PERIOD / PHYSICS_DT))
        if tick * CONTROL_PERIOD < SETTLED:
            begun = data.qpos.copy()
        else:
            depth.append(float(told.depth[0]))
    gone, _, turned = data.qpos - begun
    return float(1.0 - gone / (turned * shape.tip)), float(np.mean(depth))


def _step(bed: Bed, surface: Surface, memory: Memory, felt: Array
          ) -> tuple[Array, Array, Memory, Told]:
    forces, memory, told = soil_forces(bed, surface, memory, felt_of(felt))
    return forces, radii(bed, memory.depth), memory, told
