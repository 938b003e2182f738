"""`moonteam rollout`: a mission in physics, from the file to video and report."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import msgspec
import tyro

from moonteam import __version__, files, paths
from moonteam import mission as missions
from moonteam.errors import InputError
from moonteam.mission import Mission

if TYPE_CHECKING:
    from moonteam.planners.base import Planner
    from sim2grid.execute import Execution
    from sim2grid.film import Film
    from sim2grid.metrics import GridPlan, Report
    from sim2grid.prepare import Prepared


@dataclass(frozen=True)
class Args:
    """Run a mission in physics: a video, a map of the paths and a report.

    The planner decides on the grid; every move becomes a waypoint that a simulated robot has to
    reach over lunar ground; where the robots really are is what the planner sees next.
    Exit code 0 if every target was solved, 1 if the mission failed.

    Files in the output folder: video.mp4 (map.mp4 where no 3-D pictures can be made), paths.png,
    report.json (the same for the same seed), timing.json (wall-clock times), config.json.

    Examples:
      moonteam rollout demo
      moonteam rollout outpost --planner exact --backend native --out runs/outpost
      moonteam rollout my_mission.yaml --planner exact --no-video --json
    """

    mission: tyro.conf.Positional[str]
    """Mission file (.yaml) or the name of a bundled mission."""
    planner: Literal["policy", "exact", "greedy"] = "policy"
    """Who decides: a learned policy, the exact planner, or greedy insertion."""
    policy: str = "small"
    """Policy file (.safetensors) or the name of a bundled policy, for --planner policy."""
    decode: str = "argmax"
    """How actions are read from the policy: argmax, sample or best-of-K such as best-of-16."""
    objective: Literal["makespan", "moves", "weighted"] = "makespan"
    """What the planner minimises (exact, greedy, and policy with best-of-K)."""
    mode: Literal["barrier", "async"] = "barrier"
    """barrier: all robots decide together; async: each decides when it arrives."""
    backend: Literal["mjx", "native"] = "mjx"
    """Physics engine: MJX (JAX) or C MuJoCo, which is faster on a CPU."""
    seed: int = 0
    """Seed of what is random in the planner; the ground has its own seed in the mission."""
    out: Path | None = None
    """Output folder; runs/NAME by default."""
    video: bool = True
    """Make the video."""
    json: bool = False
    """Print the report as one JSON document and nothing else."""


def run(args: Args) -> int:
    """Runs the mission and writes its folder; the exit code says whether it succeeded."""
    mission = _load(args)
    from moonteam.compilation import enable_cache

    enable_cache()
    from sim2grid.prepare import prepare

    planner = _planner(args)
    prepared = prepare(mission, args.mission)
    plan = _grid_plan(args, prepared, planner)
    out = args.out or Path("runs") / mission.name
    _make_folder(out, args, mission)
    execution = _execution(args, prepared, planner)
    interrupted = False
    try:
        timing = _drive(args, prepared, execution)
    except KeyboardInterrupt:
        interrupted, timing = True, {}
    report = _report(args, prepared, execution, plan)
    files.write_json(out / "report.json", report)
    files.write_json(out / "timing.json", timing)
    film = _film(args, prepared, execution)
    _save_paths(film, out)
    if interrupted:
        print(f"moonteam: stopped after {report.seconds:g} s of the mission; {out}/report.json "
              "holds what was done", file=sys.stderr)
        return 130
    made = _save_video(film, prepared, out) if args.video else None
    if args.json:
        print(files.dump_json(report))
    else:
        _show(report, timing, out, made)
    return 0 if report.success else 1


def _load(args: Args) -> Mission:
    """The mission, named after its file where it has no name. Raises InputError."""
    if args.seed < 0:
        raise InputError("--seed", f"{args.seed} is not allowed; at least 0")
    suffix = ".yml" if args.mission.endswith(".yml") else ".yaml"
    path = paths.find(args.mission, "missions", suffix)
    mission = missions.load(path)
    if args.out is not None and args.out.exists() and not args.out.is_dir():
        raise InputError("--out", f"{args.out} is a file; a folder is needed")
    return msgspec.structs.replace(mission, name=mission.name or path.stem)


def _planner(args: Args) -> Planner:
    from moonteam.evaluation.decode import parse
    from sim2grid.brains import make_planner

    parse(args.decode)
    policy = None
    if args.planner == "policy":
        policy = paths.find(args.policy, "policies", ".safetensors")
    return make_planner(args.planner, policy=policy, objective=args.objective,
                        decode=args.decode)


def _grid_plan(args: Args, prepared: Prepared, planner: Planner) -> GridPlan:
    """The planner on the grid alone. Raises InputError if it cannot serve this mission."""
    from sim2grid.metrics import GridPlan
    from sim2grid.replan import grid_trace

    trace = grid_trace(prepared.scenario, planner, args.seed)
    return GridPlan(trace.complete, trace.makespan, trace.moves)


def _make_folder(out: Path, args: Args, mission: Mission) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("--out", f"{out} cannot be made: {error.strerror}") from None
    for name in ("video.mp4", "map.mp4", "paths.png", "report.json", "timing.json"):
        (out / name).unlink(missing_ok=True)  # of an earlier run
    options = {key: value for key, value in asdict(args).items() if key not in ("out", "json")}
    files.write_json(out / "config.json", {
        "moonteam": __version__, "options": options, "mission": msgspec.to_builtins(mission)})


def _execution(args: Args, prepared: Prepared, planner: Planner) -> Execution:
    from sim2grid.execute import Execution

    return Execution(prepared.mission, prepared.scenario, planner, prepared.bodies,
                     prepared.frame, seed=args.seed, mode=args.mode)


def _drive(args: Args, prepared: Prepared, execution: Execution) -> dict[str, float]:
    """Runs the physics; returns wall-clock times. Raises KeyboardInterrupt when stopped."""
    from moonteam.physics.backends import make_backend
    from sim2grid.drive import run as run_executions

    _say(f"compiling the {args.backend} physics "
               "(kept for later runs; the first time takes longest)")
    backend = make_backend(args.backend, prepared.scene)
    begun = time.perf_counter()
    looks: list[float] = []
    total = len(execution.record.targets)
    with _bar("mission", total) as update:

        def look() -> None:
            looks.append(time.perf_counter())
            solved = int(execution.snapshot.solved.sum())
            update(solved, f"{execution.time:.1f} s, decision {execution.decision}, "
                           f"{solved} of {len(execution.record.targets)} targets")

        run_executions([execution], backend, prepared.scene.qpos0, look)
    if not looks:
        return {"compile_s": 0.0, "wall_s": time.perf_counter() - begun}
    running = looks[-1] - looks[0]
    simulated = execution.record.seconds() - execution.rules.chunk_s
    return {"compile_s": round(looks[0] - begun, 3), "wall_s": round(looks[-1] - begun, 3),
            "real_time_factor": round(simulated / max(running, 1e-9), 3)}


def _report(args: Args, prepared: Prepared, execution: Execution,
            plan: GridPlan) -> Report:
    from sim2grid.metrics import make_report
    from sim2grid.slip import ground_height

    objective = None if args.planner == "policy" else args.objective
    return make_report(
        execution.record, prepared.mission, prepared.frame, prepared.bases,
        planner=args.planner, objective=objective, mode=args.mode, backend=args.backend,
        seed=args.seed, grid_plan=plan,
        height=ground_height(prepared.site.heights, prepared.site.spacing))


def _film(args: Args, prepared: Prepared, execution: Execution) -> Film:
    from sim2grid.film import Film
    from sim2grid.picture import Ground

    who = args.planner if args.planner != "policy" else f"policy {Path(args.policy).stem}"
    return Film(prepared.mission, execution.record, prepared.frame,
                Ground(prepared.site.heights, prepared.site.spacing), prepared.bases,
                f"{prepared.mission.name}: {who}", prepared.barred())


def _save_paths(film: Film, out: Path) -> None:
    with files.replacing(out / "paths.png") as temporary:
        film.last_map(960).save(temporary)


def _save_video(film: Film, prepared: Prepared, out: Path) -> Path:
    """video.mp4, or map.mp4 where there is nothing to render with, with a word about why."""
    from moonteam.physics.render import RenderingUnavailable
    from sim2grid.film import write
    from sim2grid.views import SceneViews

    path, views = out / "video.mp4", None
    try:
        views = SceneViews(prepared, film)
        film = film.with_views(views)
    except RenderingUnavailable as error:
        print(f"moonteam: {error}", file=sys.stderr)
        print("moonteam: no 3-D video; making map.mp4 instead", file=sys.stderr)
        path = out / "map.mp4"
    count = 0
    with _bar("video", film.num_frames) as update:

        def drawn() -> None:
            nonlocal count
            count += 1
            update(count, path.name)

        write(film, path, drawn)
    if views is not None:
        views.shut()
    return path


@contextlib.contextmanager
def _bar(title: str, total: int) -> Iterator[Callable[[int, str], None]]:
    """A progress bar on standard error if that is a terminal: `update(done, words)`."""
    if not sys.stderr.isatty():
        yield lambda done, words: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    with Progress(TextColumn(title), BarColumn(), TextColumn("{task.fields[words]}"),
                  TimeElapsedColumn(), console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(title, total=total, words="")
        yield lambda done, words: progress.update(task, completed=done, words=words)


def _say(text: str) -> None:
    print(f"moonteam: {text}", file=sys.stderr, flush=True)


def _show(report: Report, timing: dict[str, float], out: Path, video: Path | None) -> None:
    """The report for a person."""
    print(f"{report.mission}: {'success' if report.success else 'FAILED'}"
          + (f" ({report.cause}: {report.detail})" if not report.success else ""))
    grid = report.grid_plan.makespan if report.grid_plan else None
    print(f"  {report.seconds:.1f} s of mission, {report.decisions} decisions"
          + (f" (grid plan: {grid})" if grid is not None else "")
          + f", {report.moves} moves, {report.planner}, {report.mode}, {report.backend}")
    for target in report.targets:
        by = ", ".join(f"{name} at {distance:.2f} m" for name, distance
                       in zip(target.robots, target.distance_m, strict=True))
        print(f"  target {target.name:<10} " + (
            f"solved at decision {target.decision}, {target.time_s:.1f} s, by {by}"
            if target.solved else "not solved"))
    for robot in report.robots:
        per_move = "-" if robot.seconds_per_move is None else f"{robot.seconds_per_move:.1f} s"
        print(f"  robot {robot.name:<11} {robot.kind:<8} {robot.moves} moves, {per_move} each, "
              f"{robot.distance_m:.1f} m, tilt to {robot.max_tilt_deg:.0f} deg"
              + (f", LOST: {robot.lost} at {robot.lost_s:.1f} s" if robot.lost else ""))
    if "real_time_factor" in timing:
        print(f"  {timing['compile_s']:.1f} s to compile, then "
              f"{timing['real_time_factor']:.1f} times real time")
    print(f"  {video or out / 'report.json'}")
