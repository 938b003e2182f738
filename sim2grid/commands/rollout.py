"""`moonteam rollout`: missions in physics, from the file to video and report."""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Iterator
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
from moonteam.report.progress import bar, say, track
from moonteam.version import __version__
from sim2grid.commands import filming, words
from sim2grid.commands.filming import PLAIN_S, Filmed

if TYPE_CHECKING:
    from moonteam.planners.base import Planner
    from moonteam.planners.simulate import Trace
    from sim2grid.clock.execution import TimedExecution
    from sim2grid.loop.execution import Execution
    from sim2grid.loop.prepare import Prepared
    from sim2grid.measure.metrics import GridPlan, Optimum, Report
    from sim2grid.show.film import Film
    from sim2grid.show.studio import Shooting

FILES = ("report.html", "video.mp4", "video.webp", "video.gif", "map.mp4", "map.webp", "map.gif",
         "paths.png", "report.json", "timing.json",
         "config.json")
"""In --out."""
MOST_ROWS = 1000


@dataclass(frozen=True)
class Args(Filmed, Planning, Forced, Printed):
    """Run missions in physics: a video, a map of the paths and a report of each.

    The planner decides on the grid; every move becomes a waypoint that a simulated robot has to
    reach over lunar ground; where the robots really are is what the planner sees next.
    Exit code 0 if every target was solved, 1 if a mission failed. The film of one mission is drawn
    while the next is under way.

    Files in the output folder: report.html (all of it on one page), video.mp4 (map.mp4 where no
    3-D pictures can be made, or wanted; .webp and .gif with --also), paths.png, report.json (the
    same for the same seed), timing.json (wall-clock times), config.json.

    Examples:
      moonteam rollout demo
      moonteam rollout outpost --planner exact --backend native --out runs/exact
      moonteam rollout demo outpost sampling --backend native --planner exact
      moonteam rollout my_mission.yaml --planner exact --no-video --json
      moonteam rollout demo --planner exact --backend native --viewer
      moonteam rollout demo --camera strider --seconds 12 --size 854 480 --also webp
      moonteam rollout --from runs/execution/report.json --mission 17
    """

    mission: tyro.conf.Positional[tuple[str, ...]] = ()
    """Mission files (.yaml) or names of bundled missions; not with --from."""
    planner: str | None = None
    """Who decides: a registered planner (policy, auto, exact, greedy, lns, guided, cpsat, routing,
    exhaustive, another package's), or FILE.py:OBJECT. Default: policy; by the clock exact."""
    mode: Literal["barrier", "async", "clock"] | None = None
    """barrier: all robots decide together; async: each decides when it arrives; clock: a decision
    is a target, planned in seconds and driven at any angle. Default: clock
    where the mission says clock: seconds, else barrier."""
    search: Literal["nearest", "sweep", "places", "stay", "middle"] | None = None
    """Where targets are hidden: nearest, to the nearest ground not seen yet; sweep, up and down a
    strip each; places, to look from, planned for as if they were targets (lns, policy). Default:
    nearest. Where they come: stay (default), or middle, where who has nothing to do goes to where
    the next target is soonest reached in the mean."""
    futures: int = 0
    """Where missions unfold: decides over so many sampled futures; 0 looks no further than what is
    known."""
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
    row: tuple[int, int] | None = None
    """Which row of an engine of how many: floating point may differ between rows. `evaluate soak`
    says it of its missions. Default: 0 1."""
    out: Aside[Path | None] = None
    """Output folder, of several missions OUT/NAME each; runs/NAME by default, or runs/NAME-2 and so
    on where that holds a rollout."""
    video: Aside[bool] = True
    """Make the video."""
    viewer: Aside[bool] = False
    """Show the mission in a live 3-D window while it runs; needs a display."""


FROM_REPORT = ("planner", "search", "futures", "policy", "decode", "objective", "alpha", "beta",
               "time_limit", "preference", "mode", "backend", "seed", "row")
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
    row: tuple[int, int] = (0, 1)  # of the engine, and how many it has
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
    """Runs the missions, writes their folders, prints; the exit code says whether all succeeded."""
    reports: list[Report] = []
    with contextlib.closing(carry_out(args)) as each:
        for done in each:
            report, before = done.report, done.made.before
            if done.interrupted:
                print(f"moonteam: stopped after {report.seconds:g} s of the mission; "
                      f"{done.out}/report.json holds what was done", file=sys.stderr)
                return interrupts.CODE
            reports.append(report)
            if not args.json:
                words.show(report, done.timing, done.out, done.video)
            if before is not None and report != before:
                print(f"moonteam: not as in {args.report}: {words.difference(before, report)}; "
                      "another machine or other versions?", file=sys.stderr)
    solved, several = sum(report.success for report in reports), len(args.mission) > 1
    if args.json:
        print(files.dump_json(reports if several else reports[0]))
    elif several:
        print(f"{solved} of {len(reports)} missions succeeded")
    return 0 if solved == len(reports) else 1


def carry_out(args: Args) -> Generator[Done, None, None]:
    """Runs the missions; gives each out once its folder is whole, and the one that was stopped.

    Raises InputError for whatever is wrong with any of them before anything is written.
    """
    _check(args)
    from moonteam.compilation import call_at_once, enable_cache

    enable_cache()
    call_at_once()
    if args.viewer:
        from sim2grid.show.viewer import check_display

        check_display()
    with contextlib.ExitStack() as stack:
        yield from _in_turn(_jobs(args, stack))


def film(made: Run, best: Optimum | None, path: Path) -> None:
    """The film of a mission that was run, as one file; `best` stands on its last card."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        args, take = Filmed(), _film(made, best).take
        with filming.begin(args, take, made.prepared, Path(folder)) as shooting:
            os.replace(filming.end(args, shooting, {}), path)


def folder(mission: str, out: Path | None, force: bool) -> Path:
    """The output folder of a mission's rollout."""
    default = Path("runs") / files.safe_name(mission, "mission")
    return out or (default if force else outputs.free(default, FILES))


def _folders(args: Args, missions: list[str]) -> list[Path]:
    """Those of missions of these names, no two the same."""
    if len(missions) == 1:
        return [folder(missions[0], args.out, args.force)]
    asked, found = args.out is not None or args.force, list[Path]()
    for mission in missions:
        first = (args.out or Path("runs")) / files.safe_name(mission, "mission")
        numbered = (first.with_name(f"{first.name}-{count}") for count in itertools.count(2))
        found.append(next(path for path in itertools.chain([first], numbered) if path not in found
                          and (asked or outputs.free(path, FILES) == path)))
    return found


@dataclass
class _Job:
    """One mission of the command."""

    args: Args  # with this mission alone
    made: Run
    out: Path
    held: contextlib.ExitStack  # closed when the folder is whole
    about: str  # among several, a line as it begins
    best: Optimum | None = None


@dataclass
class _Driven:
    """A job whose physics is over."""

    job: _Job
    report: Report
    timing: dict[str, float]
    film: Film
    interrupted: bool
    shooting: Shooting | None = None  # once the film is begun, if there is to be one

    @property
    def whole(self) -> bool:
        """Whether its film is there."""
        return self.shooting is not None and self.shooting.whole

    def stop(self) -> None:
        """Ends its film, unless that is there."""
        if self.shooting is not None:
            self.shooting.stop()

    def done(self, video: Path | None) -> Done:
        """What came of it."""
        return Done(self.job.made, self.report, self.timing, self.job.out, video, self.interrupted)


def _jobs(args: Args, stack: contextlib.ExitStack) -> list[_Job]:
    """All missions with their folders, held until `stack` is closed. Raises InputError."""
    runs, found = _runs(args), list[_Job]()
    outs = _folders(args, [made.prepared.mission.name for _, made in runs])
    for number, ((own, made), out) in enumerate(zip(runs, outs, strict=True), 1):
        held = stack.enter_context(contextlib.ExitStack())
        held.enter_context(outputs.folder(out, FILES, force=args.force))
        about = f"mission {number} of {len(runs)}: {made.prepared.mission.name}, in {out}"
        found.append(_Job(own, made, out, held, about if len(runs) > 1 else ""))
    print(f"moonteam: engine {found[0].made.backend}: {found[0].made.why}", file=sys.stderr)
    # Proved within so many seconds, so before a film takes its share of the processors.
    for job in track(found, "optimum", len(found)) if len(found) > 1 else found:
        job.best = job.made.best()
    return found


def _runs(args: Args) -> list[tuple[Args, Run]]:
    """Each mission ready to be run, with the arguments that ask for it alone."""
    if args.report is not None:
        made = _from_report(args)
        filming.check_camera(args, made.prepared.mission)
        return [(args, made)]
    found = []
    for name in args.mission:
        own = replace(args, mission=(name,))
        try:
            made = _from_file(own)
            filming.check_camera(own, made.prepared.mission)
        except InputError as error:
            if len(args.mission) == 1 or name in str(error):
                raise
            raise InputError(name, str(error)) from None
        found.append((own, made))
    return found


def _in_turn(jobs: list[_Job]) -> Iterator[Done]:
    """One mission after the other; the film of each is drawn while the next is driven."""
    filmed: _Driven | None = None  # the one before, if its film is under way
    try:
        while jobs:
            driven = _drive_and_save(jobs.pop(0), filmed)
            if filmed is not None:
                if driven.interrupted and not filmed.whole:
                    print(f"moonteam: {filmed.job.out}/report.json holds the one before; its film "
                          "was not finished", file=sys.stderr)
                else:
                    yield _finish(filmed)
            filmed = None
            if driven.interrupted:
                yield driven.done(None)
                return
            if driven.job.args.video:
                filmed = driven
                filmed.shooting = filming.begin(
                    driven.job.args, driven.film.take, driven.job.made.prepared, driven.job.out)
            else:
                yield _finish(driven)
        if filmed is not None:
            yield _finish(filmed)
    finally:
        if filmed is not None:
            filmed.stop()


def _drive_and_save(job: _Job, filmed: _Driven | None) -> _Driven:
    """A mission's physics and its report. Stopped, it stops the film beside it too."""
    interrupts.release()
    if job.about:
        print(f"moonteam: {job.about}", file=sys.stderr)
    made, out, interrupted = job.made, job.out, False
    _begin_folder(out, job.args, made)
    try:
        timing = _drive(job.args, made)
    except KeyboardInterrupt:
        interrupted, timing = True, {}
        if filmed is not None:
            filmed.stop()
    report = msgspec.structs.replace(_report(made), optimum=job.best)
    files.write_json(out / "report.json", report)
    files.write_json(out / "timing.json", timing)
    film = _film(made, job.best)
    _save_paths(film, out)
    return _Driven(job, report, timing, film, interrupted)


def _finish(driven: _Driven) -> Done:
    """Waits for the film if there is one, writes the rest of the folder and lets go of it."""
    job, shooting = driven.job, driven.shooting
    plots = _plots(driven.film)  # while the film is being drawn
    video = None if shooting is None else filming.end(job.args, shooting, driven.timing)
    files.write_json(job.out / "timing.json", driven.timing)
    _save_page(job.made, driven.film, plots, driven.report, driven.timing, job.out, video)
    job.held.close()
    return driven.done(video)


def _check(args: Args) -> None:
    """What can be said of the options alone. Raises InputError."""
    from moonteam.planners.decode import parse

    if args.seed < 0:
        raise InputError("--seed", f"{args.seed} is not allowed; at least 0")
    parse(args.decode)
    filming.check(args)
    if args.row is not None and not 0 <= args.row[0] < args.row[1] <= MOST_ROWS:
        raise InputError("--row", f"{args.row[0]} {args.row[1]} is not allowed; a row from 0, and "
                         f"how many there are, at most {MOST_ROWS}")
    if args.row is not None and args.backend == "fused":
        raise InputError("--row", "is for mjx and native")
    if args.mode == "clock" and args.backend == "fused":
        raise InputError("--backend fused", "drives in steps; by the clock mjx or native")
    if args.backend == "fused" and args.viewer:
        raise InputError("--viewer", "shows nothing of --backend fused, which is one program; use "
                         "mjx or native")
    if args.report is None:
        for name, value in (("--mission", args.number), ("--contender", args.contender)):
            if value is not None:
                raise InputError(name, "says which mission of a report; give --from REPORT too")
        if not any(args.mission):
            raise InputError("rollout", "give a mission file, the name of a bundled "
                             "mission, or --from REPORT --mission N")
        return
    if args.mission:
        raise InputError("--from", f"give a report or the mission {args.mission[0]}, not both")
    if args.number is None:
        raise InputError("--from", "give the number of the mission too: --mission N")
    for field in fields(args):
        if field.name in FROM_REPORT and getattr(args, field.name) != field.default:
            raise InputError(f"--{field.name}", "not with --from: the report says it")


def _from_file(args: Args) -> Run:
    """The run of a mission file. Raises InputError for whatever it cannot be."""
    from moonteam.planners import registry
    from sim2grid.loop.execution import Execution
    from sim2grid.loop.prepare import prepare

    [source] = args.mission
    mission, _ = loading.read_mission(source)
    args, why = _with_engine(args)
    mode = args.mode or ("clock" if mission.clock == "seconds" else "barrier")
    if mode == "clock":
        return _by_the_clock(args, mission, why)
    if mission.clock == "seconds":
        raise InputError(source, "is by the clock, which --mode clock alone executes",
                         "clock")
    for option, given in (("--search", args.search), ("--futures", args.futures)):
        if given:
            raise InputError(option, "is for missions by the clock that unfold")
    name = args.planner or "policy"
    planner = registry.make(name, args.planner_options())
    prepared = prepare(mission, source)
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
               row=args.row or (0, 1), why=why, best=lambda: _best(prepared, trace))


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
    from sim2grid.clock.prepare import by_the_clock, choosing, execution_of
    from sim2grid.loop.prepare import prepare
    from sim2grid.measure import optimum

    [source] = args.mission
    name = args.planner or "exact"
    _check(replace(args, planner=name, mode="clock"))
    prepared = prepare(by_the_clock(mission, source), source)
    planner = registry.find(name).make(args.planner_options(args.seed))
    who = choosing(planner, prepared.mission, args.search, args.futures, args.seed)
    execution = execution_of(prepared, who, args.seed)
    words = name if name != "policy" else f"policy {Path(args.policy).stem}"

    def best() -> Optimum | None:
        """Of what is known at the start; where more comes it means nothing."""
        return None if mission.unfolds else optimum.in_seconds(
            name, args.planner_options(args.seed), execution.task.first(execution.roads))

    return Run(prepared, execution, prepared.scene.qpos0, None, name,
               None if name == "policy" else args.objective, args.backend or "", args.seed,
               f"{mission.name}: {words}, by the clock", command.line("rollout", args),
               row=args.row or (0, 1), why=why, best=best)


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
               (row.slot, staged.width), row.report)


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
               if key not in ("out", "json", "force")} | {"mission": "".join(args.mission)}
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

        row, width = made.row
        run_executions([execution], backend, made.start, look, width=width, rows=[row])
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
        Ground.of(site), made.title, actors_of(prepared), prepared.barred(),
        ways, () if prepared.mission.unfolds else optimum.lines(best),
        f"{site.name} ground, seed {site.seed}" + words.sunlight(site.sun)))


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
