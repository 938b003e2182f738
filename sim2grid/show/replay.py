"""The replay in 3-D of a rollout's page: what `assets/replay/replay.js` draws with three.js.

All of it stands in the page: the library, our script, and the mission as one deflated block. A
pose is kept as MuJoCo has it, a free joint and joint angles, and the page moves the bodies by
their joints; each number is one of 65,536 between the least and the greatest that it takes
(1 mm on a map of 65 m), kept as the difference from the one before, so that what stands still
costs nothing. Poses are taken RATE times a second, or as often as `LARGEST` allows; the ground
keeps at most GROUND_SIDE samples a side, a mesh at most MOST_FACES faces, else its convex hull.

Legend: R robots, K kept moments, C numbers a pose, N vertices.
"""

from __future__ import annotations

import base64
import html
import math
import struct
import zlib
from typing import Any

import msgspec
import mujoco
import numpy as np
import numpy.typing as npt
import trimesh

from moonteam import paths
from moonteam.physics import look
from moonteam.physics.render import SHOWN_GROUPS
from moonteam.planners.seconds.keeper import HOME, WAIT
from moonteam.problem.scenario import ACTIONS
from moonteam.robots.base import RobotKind
from moonteam.terrain.site import Site
from sim2grid.clock.unfold import LOOK
from sim2grid.loop.prepare import Prepared
from sim2grid.loop.record import SETTING_OUT, Leg
from sim2grid.measure.slip import ground_height, slip
from sim2grid.measure.story import NEWS, Story
from sim2grid.show.picture import OPEN, REPLAN, SOLVED, STATES, requirement, robot_color
from sim2grid.show.plots import hexed

LARGEST = 6_000_000
"""Bytes of the page that the replay may take, library included."""

RATE = 25.0
"""Poses a second, at most as many as are logged."""

GROUND_SIDE = 401
MOST_FACES = 4000
MOST_BOULDERS = 1500
LOWEST = math.radians(10.0)
"""A sun that is lower is drawn as high as this: its light on the ground would be too faint."""
SLIP_EVERY, SLIP_WINDOW = 0.5, 4.0
"""s between two figures of slip, and the s of motion that each is taken over."""

LIBRARY = ("three.module.min.js", "OrbitControls.js")
"""three.js 0.170.0 as npm has it (`npm pack three@0.170.0`), to the byte."""

GEOM = mujoco.mjtGeom
SHAPES = {int(GEOM.mjGEOM_SPHERE): "sphere", int(GEOM.mjGEOM_CAPSULE): "capsule",
          int(GEOM.mjGEOM_ELLIPSOID): "ellipsoid", int(GEOM.mjGEOM_CYLINDER): "cylinder",
          int(GEOM.mjGEOM_BOX): "box", int(GEOM.mjGEOM_MESH): "mesh"}
JOINTS = {int(mujoco.mjtJoint.mjJNT_FREE): "free", int(mujoco.mjtJoint.mjJNT_BALL): "ball",
          int(mujoco.mjtJoint.mjJNT_SLIDE): "slide", int(mujoco.mjtJoint.mjJNT_HINGE): "hinge"}


class Block:
    """Arrays behind one another, each at a multiple of 4 bytes, named by where they lie."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, array: npt.NDArray[Any]) -> list[Any]:
        """[type, first byte, length] of an array, as the page's script reads it."""
        data = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes()
        at, kind = self._size, array.dtype.kind + str(array.dtype.itemsize)
        data += b"\0" * (-len(data) % 4)
        self._parts.append(data)
        self._size += len(data)
        return [kind, at, int(array.size)]

    def text(self, head: dict[str, Any]) -> str:
        """The head's length, the head as JSON and all arrays, deflated, in base64."""
        words = msgspec.json.encode(head)
        words += b" " * (-len(words) % 4)
        whole = struct.pack("<I", len(words)) + words + b"".join(self._parts)
        return base64.b64encode(zlib.compress(whole, 9)).decode()


def replay(story: Story, prepared: Prepared) -> str:
    """The replay as a part of a page, at most LARGEST bytes of it."""
    library = [(paths.assets() / "replay" / name).read_bytes() for name in LIBRARY]
    script = (paths.assets() / "replay" / "replay.js").read_text()
    names = ("three", "three/addons/controls/OrbitControls.js")
    imports = {"imports": {name: _module(code) for name, code in zip(names, library, strict=True)}}
    frame = _frame(msgspec.json.encode(imports).decode(), script)
    rate = RATE
    while len(frame) + len(data := mission_data(story, prepared, rate)) > LARGEST and rate > 0.5:
        rate /= 2
    return frame.replace("@DATA@", data)


def _module(code: bytes) -> str:
    return "data:text/javascript;base64," + base64.b64encode(code).decode()


def _frame(imports: str, script: str) -> str:
    licence = (paths.assets() / "replay" / "LICENSE-three.txt").read_text()
    return f"""<div class="replay" id="replay">
<div class="stage"><canvas tabindex="0" aria-label="the mission in 3-D"></canvas>
<div class="told" role="status">drag to turn, wheel to come near, click a robot</div></div>
<div class="ticks"></div>
<input class="clock" type="range" min="0" max="1" step="0.01" value="0" aria-label="mission time">
<div class="keys"><button class="play" type="button">play</button>
<label><select class="pace" aria-label="times real time"></select></label>
<output class="time"></output>
<label><input class="follow" type="checkbox"> follow</label><span class="team"></span></div>
<details><summary>events</summary><ol class="events"></ol></details>
<noscript><p class="bad">The replay needs JavaScript.</p></noscript>
</div>
<script type="importmap">{imports}</script>
<script type="application/base64" id="replay-data">@DATA@</script>
<script type="module">
{script}</script>
<details><summary>three.js, which draws the replay</summary>
<pre>{html.escape(licence)}</pre></details>
"""


def mission_data(story: Story, prepared: Prepared, rate: float) -> str:
    """Everything that moves or stands, deflated, in base64; `rate` poses a second at most."""
    block = Block()
    site, frame = prepared.site, story.frame
    half = [n * frame.cell_m / 2 for n in frame.size]
    head = {
        "seconds": story.record.seconds(), "half": half, "cell": frame.cell_m,
        "sun": [look.bearing(site.sun), look.SUN_ELEVATION if site.sun is None
                else max(site.sun.elevation, LOWEST)],
        "colours": {"open": hexed(OPEN), "solved": hexed(SOLVED), "replan": hexed(REPLAN),
                    "serving": hexed(STATES["late"])},
        "ground": _ground(site, prepared.barred(), half, frame.cell_m, block),
        "boulders": [_boulder(b, block) for b in site.boulders[:MOST_BOULDERS]],
        **_bodies(prepared, block), "poses": _poses(story, rate, block),
        "robots": [_robot(story, prepared, i, block) for i in range(len(prepared.bodies))],
        "targets": _targets(story), "events": _events(story)}
    return block.text(head)


def quantised(values: npt.NDArray, block: Block) -> dict[str, Any]:
    """Values [..., C] as low + step * number, with a low and a step for each of C."""
    flat = values.reshape(-1, values.shape[-1]).astype(np.float64)
    low = flat.min(axis=0)
    step = np.maximum((flat.max(axis=0) - low) / 65535, 1e-12)
    return {"low": low.tolist(), "step": step.tolist(),
            "data": block.add(np.rint((flat - low) / step).astype(np.uint16))}


def _ground(site: Site, barred: npt.NDArray[np.bool_] | None, half: list[float], cell: float,
            block: Block) -> dict[str, Any]:
    """Every stride-th elevation, the south-west one first, and where robots cannot go."""
    ny, nx = site.heights.shape
    stride = max(1, -(-max(nx, ny) // GROUND_SIDE))
    heights = site.heights[::stride, ::stride]
    spacing = site.spacing * stride
    shut = np.zeros(heights.shape, np.uint8)
    if barred is not None:
        x, y = (np.floor((spacing * np.arange(n) - e + h) / cell).astype(int) for n, e, h in zip(
            heights.shape[::-1], site.extent, half, strict=True))
        inside = (((y >= 0) & (y < barred.shape[0]))[:, None]
                  & ((x >= 0) & (x < barred.shape[1]))[None, :])
        shut[inside] = barred[np.clip(y, 0, barred.shape[0] - 1)[:, None],
                              np.clip(x, 0, barred.shape[1] - 1)[None, :]][inside]
    return {"shape": list(heights.shape), "spacing": spacing,
            "corner": [-e for e in site.extent], "shut": block.add(shut),
            "heights": quantised(heights.reshape(-1, 1), block)}


def _boulder(boulder: Any, block: Block) -> dict[str, Any]:
    return {"at": boulder.centre.tolist(), **_hull(boulder.vertices, block)}


def _hull(vertices: npt.NDArray, block: Block) -> dict[str, Any]:
    """The convex hull of vertices [N, 3]."""
    hull = trimesh.convex.convex_hull(vertices)
    return {"vertices": quantised(np.asarray(hull.vertices), block),
            "faces": block.add(np.asarray(hull.faces, np.uint16).ravel())}


def _bodies(prepared: Prepared, block: Block) -> dict[str, Any]:
    """Bodies of the robots with their joints, and what is seen of each."""
    model = prepared.scene.model
    roots = {robot.body: i for i, robot in enumerate(prepared.scene.robots)}
    bodies, geoms = {}, []
    for b in range(1, model.nbody):
        root = int(model.body_rootid[b])
        if root not in roots:
            continue
        first, count = int(model.body_jntadr[b]), int(model.body_jntnum[b])
        bodies[b] = {
            "robot": roots[root], "parent": int(model.body_parentid[b]),
            "pos": model.body_pos[b].tolist(), "quat": model.body_quat[b].tolist(),
            "joints": [{"type": JOINTS[int(model.jnt_type[j])], "at": int(model.jnt_qposadr[j]),
                        "pos": model.jnt_pos[j].tolist(), "axis": model.jnt_axis[j].tolist(),
                        "zero": float(model.qpos0[model.jnt_qposadr[j]])}
                       for j in range(first, first + count)]}
    meshes: dict[int, dict[str, Any]] = {}
    for g in range(model.ngeom):
        body, kind = int(model.geom_bodyid[g]), SHAPES.get(int(model.geom_type[g]))
        rgba = model.mat_rgba[model.geom_matid[g]] if model.geom_matid[g] >= 0 else (
            model.geom_rgba[g])
        if body not in bodies or kind is None or not SHOWN_GROUPS[model.geom_group[g]] or (
                rgba[3] == 0.0):
            continue
        geom = {"body": body, "type": kind, "size": model.geom_size[g].tolist(),
                "pos": model.geom_pos[g].tolist(), "quat": model.geom_quat[g].tolist(),
                "rgba": [round(float(v), 3) for v in rgba]}
        if kind == "mesh":
            m = int(model.geom_dataid[g])
            geom["mesh"] = m
            if m not in meshes:
                meshes[m] = _mesh(model, m, block)
        geoms.append(geom)
    return {"bodies": bodies, "geoms": geoms, "meshes": meshes}


def _mesh(model: mujoco.MjModel, mesh: int, block: Block) -> dict[str, Any]:
    vertices = model.mesh_vert[model.mesh_vertadr[mesh]:][:model.mesh_vertnum[mesh]]
    faces = model.mesh_face[model.mesh_faceadr[mesh]:][:model.mesh_facenum[mesh]]
    if len(faces) > MOST_FACES or len(vertices) > 65535:
        return _hull(vertices, block)
    return {"vertices": quantised(vertices, block),
            "faces": block.add(faces.astype(np.uint16).ravel())}


def _poses(story: Story, rate: float, block: Block) -> dict[str, Any]:
    """Times [K] and poses [C, K], number by number over time, each from the one before."""
    keep = kept(story.times, rate)
    poses = _known(story.qpos[keep].astype(np.float64))
    low = poses.min(axis=0)
    step = np.maximum((poses.max(axis=0) - low) / 65535, 1e-12)
    numbers = np.rint((poses - low) / step).astype(np.uint16).T
    first = np.zeros((len(numbers), 1), np.uint16)
    return {"times": block.add(story.times[keep].astype(np.float32)), "low": low.tolist(),
            "step": step.tolist(), "data": block.add(np.diff(numbers, axis=1, prepend=first))}


def kept(times: npt.NDArray, rate: float) -> npt.NDArray[np.int64]:
    """Rows [K] of times [T] at most `rate` a second, the first and the last among them."""
    span = float(times[-1] - times[0])
    count = min(len(times), int(np.ceil(span * rate)) + 1)
    return np.unique(np.rint(np.linspace(0, len(times) - 1, max(count, 2))).astype(np.int64))


def _known(poses: npt.NDArray) -> npt.NDArray:
    """Poses [K, C] in which what is not a number keeps the last value that was one."""
    good = np.isfinite(poses)
    last = np.maximum.accumulate(np.where(good, np.arange(len(poses))[:, None], 0), axis=0)
    return np.nan_to_num(np.take_along_axis(poses, last, axis=0), posinf=0.0, neginf=0.0)


def _robot(story: Story, prepared: Prepared, i: int, block: Block) -> dict[str, Any]:
    spec, robot = story.mission.robots[i], prepared.scene.robots[i]
    loss = next((x for x in story.record.losses if x.robot == i), None)
    legs = [leg for leg in story.record.legs if leg.robot == i]
    return {
        "name": spec.name, "kind": spec.kind, "skills": list(spec.skills),
        "colour": hexed(robot_color(i)), "base": prepared.bodies[i].base,
        "flies": robot.kind.flies, "footprint": robot.kind.footprint,
        "lost": None if loss is None else [round(loss.time_s, 3), loss.cause.replace("_", " ")],
        "legs": [_leg(leg) for leg in legs], "choices": _choices(story, i, legs),
        "slip": block.add(slips(story, robot.kind, robot.qpos, prepared.site)),
        "slip_every": SLIP_EVERY}


def _leg(leg: Leg) -> list[Any]:
    return [round(leg.start_s, 3), None if leg.end_s is None else round(leg.end_s, 3), leg.ended,
            leg.moving or leg.action == SETTING_OUT,
            *(round(float(v), 3) for v in (*leg.start_xy, *leg.waypoint))]


def _choices(story: Story, i: int, legs: list[Leg]) -> list[tuple[float, str]]:
    """When the robot was told something else, and what, for a person."""
    record, said = story.record, []
    if legs and legs[0].expected_s is not None:
        names = {WAIT: "waits", HOME: "goes home", LOOK: "looks"}
        names |= {j: f"goes for {name}" for j, name in enumerate(record.target_names)}
        # In a service nobody follows what is decided for later.
        busy = [(s.time_s - record.targets[s.target].service, s.time_s)
                for s in record.solves if i in s.robots]
        said = [(d.time_s, names[int(d.actions[i])]) for d in record.decisions
                if not any(begun <= d.time_s < done for begun, done in busy)]
    else:
        said = [(leg.start_s, f"{ACTIONS[leg.action]}, to cell {leg.goal_cell[0]}, "
                 f"{leg.goal_cell[1]}" if leg.moving else ACTIONS[leg.action]) for leg in legs]
    return [(round(time, 3), words) for k, (time, words) in enumerate(said)
            if k == 0 or words != said[k - 1][1]]


def slips(story: Story, kind: RobotKind, mine: slice, site: Site) -> npt.NDArray[np.float32]:
    """Slip every SLIP_EVERY s over the SLIP_WINDOW s about it; not a number where there is none."""
    times, height = story.times, ground_height(site.heights, site.spacing)
    found = []
    for t in np.arange(0.0, times[-1] + SLIP_EVERY, SLIP_EVERY):
        first, last = np.searchsorted(times, [t - SLIP_WINDOW / 2, t + SLIP_WINDOW / 2])
        value = slip(kind, story.qpos[first:last, mine], height)
        found.append(np.nan if value is None else value)
    return np.array(found, np.float32)


def _targets(story: Story) -> list[dict[str, Any]]:
    """Where each is, what it needs, and from when to when it is what."""
    record, own = story.record, len(story.mission.targets)
    solves = {s.target: s for s in record.solves}
    told = [r.time_s for r in story.replans if r.cause in NEWS]
    found = []
    for j, target in enumerate(record.targets):
        solve, late = solves.get(j), j - own
        since = told[late] if 0 <= late < len(told) else 0.0
        xy = story.frame.centre(np.array(target.at, float))
        found.append({
            "name": record.target_names[j], "needs": requirement(target), "at": xy.tolist(),
            "known": since, "appears": target.appears or since, "lapses": target.lapses,
            "service": target.service, "solved": None if solve is None else solve.time_s,
            "by": [] if solve is None else list(solve.robots)})
    return found


def _events(story: Story) -> list[list[Any]]:
    """[second, kind, words]: targets solved, robots lost, causes of new plans."""
    names, record = [robot.name for robot in story.mission.robots], story.record
    found = [[s.time_s, "solved", f"{record.target_names[s.target]} solved by "
              + ", ".join(names[i] for i in s.robots)] for s in record.solves]
    found += [[x.time_s, "lost", f"{names[x.robot]} lost: {x.cause.replace('_', ' ')}"]
              for x in record.losses]
    found += [[r.time_s, "replan", f"new plan: {r.words}"] for r in story.replans
              if r.cause != "robot_lost"]
    return sorted(([round(t, 3), kind, words] for t, kind, words in found), key=lambda e: e[0])
