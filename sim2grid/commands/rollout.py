"""`moonteam rollout`: a mission in physics, from the file to video and report."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

import msgspec
import numpy.typing as npt
import tyro

from moonteam import files, interrupts, loading, outputs
from moonteam.commands.options import Forced, Planning, Printed
from moonteam.errors import InputError
from moonteam.problem.mission import Mission
from moonteam.report import command
from moonteam.report.command import Aside
from moonteam.report.progress import bar, say
from moonteam.version import __version__

if TYPE_CHECKING:
    from moonteam.planners.base import Planner
    from moonteam.planners.simulate import Trace
    from sim2grid.clock.execution import TimedExecution
    from sim2grid.loop.execution import Execution
    from sim2grid.loop.prepare import Prepared
    from sim2grid.measure.metrics import GridPlan, Optimum, Report
    from sim2grid.show.film import Film
    from sim2grid.show.studio import Shooting
    from sim2grid.show.take import Style, Take

FILES = ("report.html", "video.mp4", "video.webp", "video.gif", "map.mp4", "map.webp", "map.gif",
         "paths.png", "report.json", "timing.json",
         "config.json")
"""In --out."""
PLAIN_S = 10.0
"""Between two lines on how far it is, where standard error is no terminal."""


@dataclass(frozen=True)
class Filmed:
    """How the film is made."""

    size: Aside[tuple[int, int]] = (1280, 720)
    """Width and height of the film, pixels, both even."""
    fps: Aside[float] = 30.0
    """Pictures a second."""
    seconds: Aside[float] = 24.0
    """Length of the film, title and end included; shorter where the mission is."""
    speed: Aside[float | None] = None
    """How fast wide pictures run, close ones being at true speed; the film is as long as that
    takes. Default: as --seconds asks for."""
    camera: Aside[str] = "auto"
    """auto cuts from wide pictures to whatever happens; wide, chase, or the name of a robot: one
    camera all the time, which goes along with it."""
    shadows: Aside[bool] = True
    """Robots cast shadows."""
    layout: Aside[Literal["inset", "clean", "map"]] = "inset"
    """inset: the map and the lists lie over the picture; clean: names alone; map: no 3-D picture,
    the map fills the film."""
    also: Aside[tuple[Literal["webp", "gif"], ...]] = ()
    """The film once more, small, for a README."""


@dataclass(frozen=True)
class Args(Filmed, Planning, Forced, Printed):
    """Run a mission in physics: a video, a map of the paths and a report.

    The planner decides on the grid; every move becomes a waypoint that a simulated robot has to
    reach over lunar ground; where the robots really are is what the planner sees next.
    Exit code 0 if every target was solved, 1 if the mission failed.

    Files in the output folder: report.html (all of it on one page), video.mp4 (map.mp4 where no
    3-D pictures can be made, or wanted; .webp and .gif with --also), paths.png, report.json (the
    same for the same seed), timing.json (wall-clock times), config.json.

    Examples:
      moonteam rollout demo
      moonteam rollout outpost --planner exact --backend native --out runs/exact
      moonteam rollout my_mission.yaml --planner exact --no-video --json
      moonteam rollout demo --planner exact --backend native --viewer
      moonteam rollout demo --camera strider --seconds 12 --size 854 480 --also webp
      moonteam rollout --from runs/execution/report.json --mission 17
    """

    mission: tyro.conf.Positional[str] = ""
    """Mission file (.yaml) or the name of a bundled mission; not with --from."""
    planner: str | None = None
    """Who decides: a registered planner (policy, auto, exact, greedy, lns, cpsat, exhaustive,
    another package's), or FILE.py:OBJECT. Default: policy; by the clock exact."""
    mode: Literal["barrier", "async", "clock"] | None = None
    """barrier: all robots decide together; async: each decides when it arrives; clock: a decision
    is a target, planned in seconds and driven at any angle. Default: clock
    where the mission says clock: seconds, else barrier."""
    backend: Literal["mjx", "native", "fused"] | None = None
    """Physics engine: native (C MuJoCo), mjx (MuJoCo in JAX), or fused, the whole loop on MJX as
    one program, for a policy's likeliest actions in barrier mode. Default: native where JAX
    computes on a CPU, on which it is three times as fast, else mjx."""
    seed: int = 0
    """Seed of what is random in the planner; the ground has its own seed in the mission."""
    report: Annotated[Path | None, tyro.conf.arg(name="from", metavar="REPORT")] = None
    """Instead of a mission file: report.json of `moonteam evaluate execution`. The mission is run
    again as it was then, planner and seed included, and ends as it did on the same machine."""
    number: Annotated[int | None, tyro.conf.arg(name="mission", metavar="N")] = None
    """Number of the mission in --from."""
    contender: str | None = None
    """Whose run of it, a name in --from such as "closed exact barrier"; the first by default."""
    out: Aside[Path | None] = None
    """Output folder; runs/NAME by default, or runs/NAME-2 and so on where that holds a rollout."""
    video: Aside[bool] = True
    """Make the video."""
    viewer: Aside[bool] = False
    """Show the mission in a live 3-D window while it runs; needs a display."""


FROM_REPORT = ("planner", "policy", "decode", "objective", "alpha", "beta", "time_limit",
               "preference", "mode", "backend", "seed")
"""Options that a report answers for its missions."""


@dataclass(frozen=True)
class Run:
    """One mission ready to be run: what to execute, where, and how to call it in the report."""

    prepared: Prepared
    execution: Execution | TimedExecution
    start: npt.NDArray  # [nq]
    plan: GridPlan | None  # None by the clock
    who: str  # the planner's name in the report
    objective: str | None
    backend: str
    seed: int
    title: str  # of the film
    command: str  # that makes it again
    width: int = 1  # rows of the engine
    row: int = 0  # the one that is used
    before: Report | None = None  # what came of it when it was run first
    trace: Trace | None = None  # of the plan on the grid, None by the clock
    why: str = "as the report has it"  # this engine
    best: Callable[[], Optimum | None] = lambda: None  # the optimum beside the plan, asked late


@dataclass(frozen=True)
class Done:
    """What came of it."""

    made: Run
    report: Report
    timing: dict[str, float]
    out: Path
    video: Path | None
    interrupted: bool


def run(args: Args) -> int:
    """Runs the mission, writes its folder, prints; the exit code says whether it succeeded."""
    done = carry_out(args)
    report, before = done.report, done.made.before
    if done.interrupted:
        print(f"moonteam: stopped after {report.seconds:g} s of the mission; "
              f"{done.out}/report.json holds what was done", file=sys.stderr)
        return interrupts.CODE
    if args.json:
        print(files.dump_json(report))
    else:
        _show(report, done.timing, done.out, done.video)
    if before is not None and report != before:
        print(f"moonteam: not as in {args.report}: {_difference(before, report)}; another "
              "machine or other versions?", file=sys.stderr)
    return 0 if report.success else 1


def carry_out(args: Args) -> Done:
    """Runs the mission and writes its folder. Raises InputError before anything is written."""
    _check(args)
    from moonteam.compilation import call_at_once, enable_cache

    enable_cache()
    call_at_once()
    if args.viewer:
        from sim2grid.show.viewer import check_display

        check_display()
    made = _from_file(args) if args.report is None else _from_report(args)
    _check_camera(args, made.prepared.mission)
    out = folder(made.prepared.mission.name, args.out, args.force)
    with outputs.folder(out, FILES, force=args.force):
        return _carry_out(args, made, out)


def film(made: Run, best: Optimum | None, path: Path) -> None:
    """The film of a mission that was run, as one file; `best` stands on its last card."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        args, take = Filmed(), _film(made, best).take
        with _begin_video(args, take, made.prepared, Path(folder)) as shooting:
            os.replace(_end_video(args, shooting, {}), path)


def folder(mission: str, out: Path | None, force: bool) -> Path:
    """The output folder of a mission's rollout."""
    default = Path("runs") / files.safe_name(mission, "mission")
    return out or (default if force else outputs.free(default, FILES))


def _carry_out(args: Args, made: Run, out: Path) -> Done:
    _begin_folder(out, args, made)
    print(f"moonteam: engine {made.backend}: {made.why}", file=sys.stderr)
    best, interrupted = made.best(), False
    try:
        timing = _drive(args, made)
    except KeyboardInterrupt:
        interrupted, timing = True, {}
    report = msgspec.structs.replace(_report(made), optimum=best)
    files.write_json(out / "report.json", report)
    files.write_json(out / "timing.json", timing)
    film = _film(made, best)
    _save_paths(film, out)
    if interrupted:
        return Done(made, report, timing, out, None, True)
    with contextlib.ExitStack() as stack:
        shooting = None
        if args.video:
            shooting = stack.enter_context(_begin_video(args, film.take, made.prepared, out))
        plots = _plots(film)  # while the film is being drawn
        video = _end_video(args, shooting, timing) if shooting is not None else None
    files.write_json(out / "timing.json", timing)
    _save_page(made, film, plots, report, timing, out, video)
    return Done(made, report, timing, out, video, False)


def _check(args: Args) -> None:
    """What can be said of the options alone. Raises InputError."""
    from moonteam.planners.decode import parse

    if args.seed < 0:
        raise InputError("--seed", f"{args.seed} is not allowed; at least 0")
    parse(args.decode)
    _check_film(args)
    if args.mode == "clock" and args.backend == "fused":
        raise InputError("--backend fused", "drives in steps; by the clock mjx or native")
    if args.backend == "fused" and args.viewer:
        raise InputError("--viewer", "shows nothing of --backend fused, which is one program; use "
                         "mjx or native")
    if args.report is None:
        for name, value in (("--mission", args.number), ("--contender", args.contender)):
            if value is not None:
                raise InputError(name, "says which mission of a report; give --from REPORT too")
        if not args.mission:
            raise InputError("rollout", "give a mission file, the name of a bundled "
                             "mission, or --from REPORT --mission N")
        return
    if args.mission:
        raise InputError("--from", f"give a report or the mission {args.mission}, not both")
    if args.number is None:
        raise InputError("--from", "give the number of the mission too: --mission N")
    for field in fields(args):
        if field.name in FROM_REPORT and getattr(args, field.name) != field.default:
            raise InputError(f"--{field.name}", "not with --from: the report says it")


def _check_film(args: Filmed) -> None:
    """What can be said of the film's options alone. Raises InputError."""
    if any(n % 2 or not 160 <= n <= 3840 for n in args.size):
        raise InputError("--size", f"{args.size[0]} {args.size[1]} is not allowed; both even, "
                         "from 160 to 3840")
    for name, value, least, most in (
            ("--fps", args.fps, 1, 120), ("--seconds", args.seconds, 1, 3600),
            ("--speed", args.speed, 0.1, 1000)):
        if value is not None and not least <= value <= most:
            raise InputError(name, f"{value:g} is not allowed; from {least:g} to {most:g}")


def _check_camera(args: Filmed, mission: Mission) -> None:
    """Raises InputError for a camera that goes along with nobody."""
    allowed = ["auto", "wide", "chase", *(robot.name for robot in mission.robots)]
    if args.camera not in allowed:
        raise InputError("--camera", f"no such camera or robot: {args.camera}; allowed: "
                         + ", ".join(allowed))


def _from_file(args: Args) -> Run:
    """The run of a mission file. Raises InputError for whatever it cannot be."""
    from moonteam.planners import registry
    from sim2grid.loop.execution import Execution
    from sim2grid.loop.prepare import prepare

    mission, _ = loading.read_mission(args.mission)
    args, why = _with_engine(args)
    mode = args.mode or ("clock" if mission.clock == "seconds" else "barrier")
    if mode == "clock":
        return _by_the_clock(args, mission, why)
    if mission.clock == "seconds":
        raise InputError(args.mission, "is by the clock, which --mode clock alone executes",
                         "clock")
    name = args.planner or "policy"
    planner = registry.make(name, args.planner_options())
    prepared = prepare(mission, args.mission)
    plan, trace = _grid_plan(prepared, planner, args.seed)
    execution = Execution(prepared.mission, prepared.scenario, planner, prepared.bodies,
                          prepared.frame, seed=args.seed, mode=mode)
    if args.backend == "fused":
        from sim2grid.loop.fused.whole import check

        check(execution)
    who = name if name != "policy" else f"policy {Path(args.policy).stem}"
    return Run(prepared, execution, prepared.scene.qpos0, plan, name,
               None if name == "policy" else args.objective, args.backend or "", args.seed,
               f"{mission.name}: {who}", command.line("rollout", args), trace=trace,
               why=why, best=lambda: _best(prepared, trace))


def _with_engine(args: Args) -> tuple[Args, str]:
    """The arguments with an engine, the faster one here if none is asked for, and why it is it."""
    if args.backend is not None:
        return args, "as asked for"
    import jax

    if jax.default_backend() == "cpu":
        return replace(args, backend="native"), (
            "C MuJoCo, three times as fast as mjx on a CPU; --backend mjx takes that")
    return replace(args, backend="mjx"), (
        f"MuJoCo in JAX, on {jax.default_backend()}; --backend native takes the CPU")


def _by_the_clock(args: Args, mission: Mission, why: str) -> Run:
    """The run of a mission by the clock. Raises InputError for whatever it cannot be."""
    from moonteam.planners.seconds import registry
    from sim2grid.clock.keeper import Keeper
    from sim2grid.clock.prepare import by_the_clock, execution_of
    from sim2grid.loop.prepare import prepare
    from sim2grid.measure import optimum

    name = args.planner or "exact"
    _check(replace(args, planner=name, mode="clock"))
    prepared = prepare(by_the_clock(mission, args.mission), args.mission)
    planner = registry.find(name).make(args.planner_options(args.seed))
    execution = execution_of(prepared, Keeper(planner), args.seed)
    who = name if name != "policy" else f"policy {Path(args.policy).stem}"
    return Run(prepared, execution, prepared.scene.qpos0, None, name,
               None if name == "policy" else args.objective, args.backend or "", args.seed,
               f"{mission.name}: {who}, by the clock", command.line("rollout", args), why=why,
               best=lambda: optimum.in_seconds(name, args.planner_options(args.seed),
                                               execution.task.first(execution.roads)))


def _from_report(args: Args) -> Run:
    """The run of a mission of an evaluation. Raises InputError for one that is not there."""
    from sim2grid.study.restage import load_report, restage

    assert args.report is not None
    assert args.number is not None
    staged = restage(load_report(args.report), args.number, args.report, args.contender)
    row, contender = staged.row, staged.contender
    command_line = command.line("rollout", replace(args, contender=contender.name))
    return Run(staged.prepared, staged.execution, staged.prepared.scene.qpos0, staged.grid_plan,
               row.report.planner, row.report.objective, contender.backend, row.seed,
               f"mission {row.number}, {row.site}: {contender.name}", command_line,
               staged.width, row.slot, row.report)


def _grid_plan(prepared: Prepared, planner: Planner, seed: int) -> tuple[GridPlan, Trace]:
    """The planner on the grid alone. Raises InputError if it cannot serve this mission."""
    from sim2grid.loop.replan import grid_trace
    from sim2grid.measure.metrics import GridPlan

    trace = grid_trace(prepared.scenario, planner, seed)
    return GridPlan(trace.complete, trace.makespan, trace.moves), trace


def _best(prepared: Prepared, trace: Trace) -> Optimum | None:
    """The optimum in steps beside the plan, where there is a plan and that is proved."""
    from moonteam.planners.base import Snapshot
    from sim2grid.measure import optimum

    return None if not trace.complete else optimum.in_steps(
        Snapshot.start(prepared.scenario), trace.actions, prepared.bodies, prepared.frame.cell_m)


def _begin_folder(out: Path, args: Args, made: Run) -> None:
    outputs.clear(out, FILES)
    options = {key: value for key, value in asdict(args).items()
               if key not in ("out", "json", "force")}
    files.write_json(out / "config.json", {
        "moonteam": __version__, "options": options, "engine": f"{made.backend}: {made.why}",
        "mission": msgspec.to_builtins(made.prepared.written)})


def _drive(args: Args, made: Run) -> dict[str, float]:
    """Runs the physics; returns wall-clock times. Raises KeyboardInterrupt when stopped."""
    from moonteam.physics.backends import make_backend
    from sim2grid.loop.drive import run as run_executions

    execution, prepared = made.execution, made.prepared
    if made.backend == "fused":
        return _drive_fused(made)
    say(f"moonteam: compiling the {made.backend} physics "
        "(kept for later runs; the first time takes longest)")
    backend = make_backend(made.backend, prepared.scene)
    begun = time.perf_counter()
    looks: list[float] = []
    with contextlib.ExitStack() as open_until:
        coming = sum(event.target is not None for event in prepared.mission.events)
        update = open_until.enter_context(bar(
            "mission", len(execution.record.targets) + coming, plain_s=PLAIN_S))
        show = None
        if args.viewer:
            from sim2grid.show.viewer import LiveView

            show = open_until.enter_context(LiveView(prepared, backend.log_every)).show

        def look() -> None:
            looks.append(time.perf_counter())
            interrupts.hold()
            solved = int(execution.snapshot.solved.sum())
            update(solved, f"{execution.book.time:.1f} s, decision {execution.book.decision}, "
                           f"{solved} of {len(execution.record.targets)} targets")
            if show:
                show(execution)

        run_executions([execution], backend, made.start, look, width=made.width, rows=[made.row])
    if not looks:
        return {"compile_s": 0.0, "wall_s": time.perf_counter() - begun}
    running = looks[-1] - looks[0]
    simulated = execution.record.seconds() - execution.asked.rules.chunk_s
    return {"compile_s": round(looks[0] - begun, 3), "wall_s": round(looks[-1] - begun, 3),
            "real_time_factor": round(simulated / max(running, 1e-9), 3)}


def _drive_fused(made: Run) -> dict[str, float]:
    """Runs the mission as one program; nothing can be seen of it before it is over."""
    from moonteam.physics.backends import MjxBackend
    from sim2grid.loop.fused import whole

    say("moonteam: compiling the whole loop as one program")
    execution = cast("Execution", made.execution)
    compiling, running = whole.run([execution], MjxBackend(made.prepared.scene),
                                   made.start[None], 1)
    return {"compile_s": round(compiling, 3), "wall_s": round(compiling + running, 3),
            "real_time_factor": round(execution.record.seconds() / max(running, 1e-9), 3)}


def _report(made: Run) -> Report:
    from sim2grid.measure.metrics import make_report
    from sim2grid.measure.slip import ground_height

    prepared = made.prepared
    return make_report(
        made.execution.record, prepared.mission, prepared.frame, prepared.bases,
        planner=made.who, objective=made.objective, mode=made.execution.asked.mode,
        backend=made.backend, seed=made.seed, grid_plan=made.plan,
        kinds=prepared.kinds, height=ground_height(prepared.site.heights, prepared.site.spacing))


def _film(made: Run, best: Optimum | None) -> Film:
    """The film as it stands on the record, without 3-D pictures."""
    from sim2grid.measure import optimum
    from sim2grid.show.film import Film
    from sim2grid.show.picture import Ground
    from sim2grid.show.take import Take, actors_of, planned_ways

    prepared, site = made.prepared, made.prepared.site
    ways = () if made.trace is None else planned_ways(made.trace.cells, prepared.frame)
    return Film(Take(
        prepared.mission, made.execution.record, prepared.frame,
        Ground(site.heights, site.spacing), made.title, actors_of(prepared), prepared.barred(),
        ways, optimum.lines(best), f"{site.name} ground, seed {site.seed}"))


def _plots(film: Film) -> list[tuple[str, str]]:
    from sim2grid.show import plots

    bases = [actor.base for actor in film.take.actors]
    return [("Who did what when", plots.timeline(film.story)),
            ("Motion", plots.motion(film.story, bases))]


def _save_page(made: Run, film: Film, plots: list[tuple[str, str]], report: Report,
               timing: dict[str, float], out: Path, video: Path | None) -> None:
    """report.html: everything on one page."""
    import yaml

    from sim2grid.show import page
    from sim2grid.show.replay import replay

    mission = msgspec.to_builtins(made.prepared.written)
    page.write(out / "report.html", page.rollout_page(
        report, command=made.command, made=video, out=out, timing=timing, why=made.why,
        replans=[(round(r.time_s, 1), r.decision, r.words) for r in film.story.replans],
        plots=plots,
        mission=yaml.safe_dump(mission, sort_keys=False, default_flow_style=None),
        replay=replay(film.story, made.prepared)))


def _save_paths(film: Film, out: Path) -> None:
    from sim2grid.show import plots

    plots.save_png(plots.paths(film.story, film.take.ground, film.take.barred), out / "paths.png")


def _style(args: Filmed) -> Style:
    from sim2grid.show.take import Style

    return Style(args.size, args.fps, args.seconds, args.speed, args.camera, args.shadows,
                 args.layout)


def _begin_video(args: Filmed, take: Take, prepared: Prepared, out: Path) -> Shooting:
    """Begins video.mp4 in processes of its own; map.mp4 where there is nothing to render with,
    with a word about why.
    """
    from moonteam.physics.render import RenderingUnavailable
    from sim2grid.show.studio import Shooting

    name = "map.mp4"
    if args.layout != "map":
        from moonteam.physics import stage

        try:
            stage.check()
            tops = prepared.site.surface.tops
            take = replace(take, model=stage.painted(prepared.scene),
                           tops=take.ground.heights if tops is None else _array(tops))
            name = "video.mp4"
        except RenderingUnavailable as error:
            print(f"moonteam: {error}", file=sys.stderr)
            print("moonteam: no 3-D video; making map.mp4 instead", file=sys.stderr)
    return Shooting(take, _style(args), out / name)


def _array(values: object) -> npt.NDArray:
    import numpy as np

    return np.asarray(values)


def _end_video(args: Filmed, shooting: Shooting, timing: dict[str, float]) -> Path:
    """Waits for the film; writes it once more as is asked for."""
    from moonteam.report import video

    with bar("video", shooting.num_frames, plain_s=PLAIN_S) as update:
        cost = shooting.wait(lambda done: update(done, shooting.path.name))
    timing |= cost.timing()
    for kind in args.also:
        video.for_readme(shooting.path, shooting.path.with_suffix(f".{kind}"))
    return shooting.path


def _difference(before: Report, now: Report) -> str:
    """The first figure in which two reports differ."""
    for name in before.__struct_fields__:
        if getattr(before, name) != getattr(now, name):
            if isinstance(getattr(now, name), tuple):
                return f"{name} differ"
            return f"{name} was {getattr(before, name)}, is {getattr(now, name)}"
    return "nothing"


def _show(report: Report, timing: dict[str, float], out: Path, video: Path | None) -> None:
    """The report for a person."""
    print(f"{report.mission}: {'success' if report.success else 'FAILED'}"
          + (f" ({report.cause}: {report.detail})" if not report.success else ""))
    grid = report.grid_plan.makespan if report.grid_plan else None
    print(f"  {report.seconds:.1f} s of mission, {report.decisions} decisions"
          + (f" (grid plan: {grid})" if grid is not None else "")
          + f", {report.moves} moves, {report.planner}, {report.mode}, {report.backend}")
    if report.optimum is not None:
        from sim2grid.measure import optimum

        print(f"  at the start: {optimum.words(report.optimum)}")
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
    print(f"  {out / 'report.html'}" + (f", {video}" if video else ""))
