"""The public face of moonteam, which `moonteam/__init__.py` names; docs/python.md shows each.

Everything takes what `load` gives, or the name or path of it, and does what the command of the
same name does, with the same options under the same names.
"""

from __future__ import annotations

import hashlib
import importlib
import inspect
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Any,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec

from moonteam import files, interrupts, loading, outputs
from moonteam.errors import InputError, meant, not_one_of
from moonteam.loading import load
from moonteam.problem.mission import Mission
from moonteam.problem.scenario import Scenario
from moonteam.problem.timed import Timed
from moonteam.registry import Registry
from moonteam.results import Evaluation, Rollout, Row, Training

if TYPE_CHECKING:  # JAX and MuJoCo, which take seconds, are loaded when they are needed
    from moonteam.planners.base import Plan, Planner
    from moonteam.planners.kind import PlannerKind
    from moonteam.planners.seconds.base import TimedPlan
    from moonteam.robots.base import RobotKind

__all__ = ["evaluate", "load", "make", "plan", "register", "rollout", "train"]

Named = str | os.PathLike[str]
WRITTEN = "mission.yaml"
"""What a mission that is an object is written as, for its rollout."""
ENVIRONMENTS: Registry[Callable[..., Any]] = Registry(
    "environment", "moonteam.environments", Callable, {  # type: ignore[arg-type]
        "MoonGrid-v0": "moonteam.grid.jaxmarl_face:MoonGrid",
        "MoonMacro-v0": "moonteam.grid.jaxmarl_macro:MoonMacro",
        "MoonMission-v0": "sim2grid.env.mission:MoonMission"})
"""What `make` makes. What an environment of a name tells, takes and pays does not change: that
needs the next number.
"""
T = TypeVar("T")


def plan(what: Named | Mission | Scenario | Timed, planner: str = "exact", **options: Any
         ) -> Plan | TimedPlan:
    """One scenario's plan, as `moonteam plan`.

    Args:
      what: a mission or scenario, in steps or by the clock, or what `load` takes for one.
      planner: a registered planner, or `FILE.py:OBJECT`.
      **options: fields of `PlannerOptions`, such as objective="moves" or time_limit=1.0.

    Returns the plan: `status`, `makespan` and `moves` in steps, `actions` [T, N], `schedule`; by
    the clock a `TimedPlan`: `makespan` ms, `services`. Raises InputError for what cannot be.
    """
    from moonteam.planners import registry
    from moonteam.planners.base import Snapshot
    from moonteam.planners.kind import PlannerOptions

    made = _built(PlannerOptions, "plan", options)
    found = loading.load_single(what) if isinstance(what, (str, os.PathLike)) else what
    if isinstance(found, Timed) or (isinstance(found, Mission) and found.clock == "seconds"):
        from moonteam.commands import clocked

        return clocked.make_plan(planner, made, clocked.case_of(found).now)
    if registry.find(planner).wants_policy:
        from moonteam import compilation

        compilation.enable_cache()
    return registry.make(planner, made).plan(Snapshot.start(
        found.scenario() if isinstance(found, Mission) else found))


def rollout(mission: Named | Mission, planner: str | None = None, *, out: Named | None = None,
            video: bool = False, **options: Any) -> Rollout:
    """A mission in physics, as `moonteam rollout`.

    Args:
      mission: a mission, its file, or the name of a bundled one.
      planner: who decides; a registered planner, or `FILE.py:OBJECT`. None: the policy, and by the
        clock the exact planner.
      out: output folder; runs/NAME by default, or runs/NAME-2 and so on where that holds a
        rollout. A `Mission` is written there as mission.yaml. Nothing there is written over
        without force=True.
      video: make the video at once; `save_video()` makes it later.
      **options: of the command, such as backend="native" or mode="async".

    Returns the `report` that is written as report.json, in SI units (`success`, `seconds`,
    `targets` and `robots` of it by themselves too), the `record` behind it, and `save_video()`; a
    notebook shows it. Raises InputError, and KeyboardInterrupt when stopped (what was done is
    saved then).
    """
    command = _command("sim2grid", "rollout")
    args = _read(command.Args, "rollout",
                 {"planner": planner, "out": out, "video": video, **options})
    if isinstance(mission, Mission):
        folder = command.folder(mission.name, args.out, args.force)
        with outputs.folder(folder, (*command.FILES, WRITTEN), force=args.force):
            [done] = command.carry_out(replace(args, out=folder,
                                               mission=(os.fspath(_write(folder, mission)),)))
    else:
        [done] = command.carry_out(replace(args, mission=(os.fspath(mission),)))
    if done.interrupted:
        raise KeyboardInterrupt
    return Rollout(done.report, done.made.execution.record, done.out,
                   partial(command.film, done.made, done.report.optimum), done.video)


def _write(folder: Path, mission: Mission) -> Path:
    import yaml

    outputs.clear(folder, (WRITTEN,))
    files.write_text(folder / WRITTEN, yaml.safe_dump(msgspec.to_builtins(mission),
                                                      sort_keys=False))
    return folder / WRITTEN


def evaluate(what: Named | Scenario | Timed | Mission | Sequence[Scenario] | Sequence[Timed]
             | Sequence[Named | Mission] | None = None,
             planner: str | Sequence[str] | None = None, **options: Any) -> Evaluation:
    """Planners side by side: plans of scenarios, as `moonteam evaluate grid`, or missions in
    physics, as `moonteam evaluate execution`.

    Args:
      what: a set, or scenarios, in steps or by the clock: their plans. A mission, its file or the
        name of a bundled one, or several of them: they are executed. None: missions are drawn, and
        executed.
      planner: one planner, or several. None: the exact planner; in physics the policy.
      **options: of the command, one value or several. Of plans: limit=20, policy="any_team",
        decode=("argmax", "best-of-16"), time_limit=0.1. Of executions: mode=("barrier", "async"),
        loop=("closed", "open"), site="mare", count=5. Nothing is written without out=FOLDER.

    Returns the document that the command prints as JSON, a dict. Its `summary` has one flat row a
    planner, its `rows` one a planner and scenario, or contender and mission, which `to_pandas()`
    makes a table of; a notebook shows it. Raises InputError, and KeyboardInterrupt when stopped
    (what was done is saved then in `out`).
    """
    given = _missions(what)
    if given is None:
        return _plans(what, {"planner": planner or "exact", **options})
    return _executions(given, options if planner is None else {"planner": planner, **options})


def _missions(what: Any) -> list[Named | Mission] | None:
    """The missions to be executed, none where they are drawn; None for scenarios."""
    if what is None:
        return []
    if isinstance(what, (str, os.PathLike)):
        return [what] if loading.names_mission(os.fspath(what)) else None
    if isinstance(what, (Mission, Scenario, Timed)):
        return [what] if isinstance(what, Mission) else None
    many = [isinstance(one, (str, os.PathLike, Mission)) for one in what]
    if any(many) and not all(many):
        raise InputError("evaluate", "missions and scenarios together; give one or the other")
    return list(what) if any(many) else None


def _plans(what: Any, options: dict[str, Any]) -> Evaluation:
    from moonteam.commands.options import keeping
    from moonteam.report import command as commands

    command = _command("moonteam", "evaluate_grid")
    if isinstance(what, (str, os.PathLike)):
        args = _read(command.Args, "evaluate", {"set": what, **options})
        found = command.load_any(args.set, args.limit)
        title, line, made = Path(args.set).stem, commands.line("evaluate grid", args), ""
    else:
        args = _read(command.Args, "evaluate", options)
        found = [what] if isinstance(what, (Scenario, Timed)) else list(what)[:args.limit]
        title, line = "scenarios", "moonteam.evaluate"
        made = hashlib.sha256(msgspec.json.encode(found)).hexdigest()
    with keeping(args, command.FILES):
        document, form = command.judged(args, found, f"{title}: {len(found)} scenarios", line, made)
        command.save(args, document, form, command.PICTURE)
    return _evaluation(document)


def _executions(given: list[Named | Mission], options: dict[str, Any]) -> Evaluation:
    from moonteam.commands.options import keeping

    command = _command("sim2grid", "evaluate_execution")
    made: list[Mission] = []
    if any(isinstance(one, Mission) for one in given):
        made = [one if isinstance(one, Mission) else loading.load_mission(os.fspath(one))
                for one in given]
    names = [one.name or "mission" for one in made] or [
        os.fspath(one) for one in given if not isinstance(one, Mission)]
    args = _read(command.Args, "evaluate", {"mission": names, **options})
    with keeping(args, command.FILES):
        document, rows = command.carry_out(args, made)
    return _evaluation(document, rows)


def _evaluation(document: dict[str, Any], rows: Sequence[Row] | None = None) -> Evaluation:
    if "interrupted" in document:
        raise KeyboardInterrupt
    return Evaluation(document, rows)


def train(preset: str, *words: str, out: Named | None = None, **options: Any) -> Training:
    """Trains a policy, as `moonteam train`.

    Args:
      preset: such as "quick", "any_team", "small" or "pi_5t".
      *words: what would stand behind it on the command line, such as "--seed", "1", "--resume".
      out: run folder; runs/PRESET-SEED by default.
      **options: the same as keywords, groups of options as dicts: seed=1, resume=True,
        bootstrap={"updates": 20}.

    Returns the run: its `folder`, the `policy` in it, its `report`, and its curve as flat `rows`,
    which `to_pandas()` makes a table of; a notebook shows it. Raises InputError for bad words,
    KeyboardInterrupt when stopped (go on with resume=True), RuntimeError if the run failed, which
    it has said why on standard error.
    """
    from moonteam import cli

    command = _command("training", "train")
    where = () if out is None else ("--out", os.fspath(out))
    said = [preset, *words, *_words(options), *where]
    try:
        args = cli.parse("train", said)
    except SystemExit:
        raise InputError("train", f"{' '.join(said)}: not understood, see above") from None
    folder = command.folder(args)
    code = command.run(args)
    if code == interrupts.CODE:
        raise KeyboardInterrupt
    if code:
        raise RuntimeError(f"training {preset} ended with exit code {code}")
    return Training.of(folder)


def _words(options: dict[str, Any], group: str = "") -> Iterable[str]:
    """Keyword options as they stand on the command line."""
    for key, value in options.items():
        name = f"{group}{key.replace('_', '-')}"
        if isinstance(value, dict):
            yield from _words(value, f"{name}.")
        elif isinstance(value, bool):
            head, dot, last = name.rpartition(".")
            yield f"--{name}" if value else f"--{head}{dot}no-{last}"
        elif isinstance(value, (list, tuple)):
            yield from (f"--{name}", *map(str, value))
        elif value is not None:
            yield from (f"--{name}", str(value))


def make(name: str, *, face: Literal["jaxmarl", "pettingzoo"] = "jaxmarl", **options: Any) -> Any:
    """An environment by its versioned name.

    Args:
      name: "MoonGrid-v0", the grid, a cell a decision; "MoonMacro-v0", a target a decision, by the
        clock; "MoonMission-v0", missions in physics; another package's, or FILE.py:OBJECT.
      face: jaxmarl, with the interface of JaxMARL's `MultiAgentEnv`; or pettingzoo, with that of
        PettingZoo's `ParallelEnv` (extra `pettingzoo`).
      **options: of the environment: config="pi_5t", family=Draw(...), mission="sampling".

    Raises InputError for a name or an option that is not there, or one that is not allowed.
    """
    made_by = ENVIRONMENTS.get(name, None)
    parameters = inspect.signature(made_by).parameters
    if not any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        for key in options:
            if key not in parameters:
                raise _unknown(f"make({key}=)", key, list(parameters))
    if face not in ("jaxmarl", "pettingzoo"):
        raise InputError("make(face=)", f"{face!r} is not allowed; jaxmarl or pettingzoo")
    env = made_by(**options)
    if face == "jaxmarl":
        return env
    from moonteam.grid import pettingzoo_face

    return pettingzoo_face.parallel(env, name)


def register(thing: RobotKind | PlannerKind | Callable[..., Planner], name: str = "") -> None:
    """Makes a kind of robot or a planner known by name in this process.

    `name` is the object's own where it is left out. Raises InputError if the name is taken, or
    the thing is neither.
    """
    from moonteam.planners import registry
    from moonteam.planners.kind import PlannerKind
    from moonteam.robots import KINDS, RobotKind

    if isinstance(thing, RobotKind):
        if name not in ("", thing.name):
            raise InputError(name, f"a kind of robot goes by its own name, {thing.name}")
        KINDS.register(thing.name, thing)
        return
    own = name or getattr(thing, "name", "") or getattr(thing, "__name__", "")
    if not callable(thing) and not isinstance(thing, PlannerKind):
        raise InputError("register", f"a {type(thing).__name__} is neither a RobotKind nor a "
                         "planner, which is a class, or a function that makes one")
    registry.register(str(own), thing)


def _command(package: str, name: str) -> Any:
    """A command's module, found by name: moonteam imports neither training nor sim2grid."""
    return importlib.import_module(f"{package}.commands.{name}")


def _built(kind: type[T], call: str, options: dict[str, Any]) -> T:
    """The dataclass made from keyword options. Raises InputError for one that it has not."""
    known = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    for key in options:
        if key not in known:
            raise _unknown(f"{call}({key}=)", key, known)
    return kind(**options)


def _read(kind: type[T], call: str, options: dict[str, Any]) -> T:
    """The arguments of a command, as its command line would give them: several values where the
    option takes several, words of those that are allowed. Raises InputError.
    """
    hints = get_type_hints(kind)
    return _built(kind, call, {
        key: _taken(hints[key], value, f"{call}({key}=)") if key in hints else value
        for key, value in options.items()})


def _taken(hint: Any, value: Any, source: str) -> Any:
    """A value as an option of this type has it. Raises InputError."""
    for kind in get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,):
        its = get_args(kind)
        if value is None or kind is Path:
            return value if value is None else Path(value)
        if get_origin(kind) is tuple:
            return tuple(_taken(its[0], one, source) for one in _several(value))
        if get_origin(kind) is Literal and value not in its:
            raise InputError(source, not_one_of(value, its))
    return os.fspath(value) if isinstance(value, os.PathLike) else value


def _unknown(source: str, key: str, known: Sequence[str]) -> InputError:
    return InputError(source, f"no such option; {meant(key, known)}allowed: {', '.join(known)}")


def _several(value: Any) -> tuple:
    """The values of an option that may be given several times."""
    return (value,) if isinstance(value, (str, int, float, os.PathLike)) else tuple(value)
