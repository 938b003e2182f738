"""Printed command lines: what is parsed back is what was asked, and gives the same figures."""

import dataclasses
import importlib
import itertools
import json
import shlex
import types
from pathlib import Path
from typing import Annotated, Literal, Union, get_args, get_origin, get_type_hints

import pytest
import tyro

from moonteam import cli
from moonteam.commands import options
from moonteam.report import command
from moonteam.report.command import Aside
from training.commands import compare, guide, imitate, refine, train

TRAIN = {"train imitate": imitate.Args, "train refine": refine.Args,
         "train compare": compare.Args, "train guide": guide.Args}
KINDS = {name: importlib.import_module(module).Args
         for name, (module, _) in cli.COMMANDS.items() if name != "train"}


def parsed(line):
    """The command's name and arguments, as `main` reads them."""
    program, *words = shlex.split(line)
    assert program == "moonteam"
    name, rest = cli.find_command(words)
    return name, cli.parse(name, rest)


def values(hint):
    """Some values that an option of this type may have."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        yield from values(inner[0])
    elif origin is Literal:
        yield from inner
    elif origin in (Union, types.UnionType):
        for one in inner:
            yield from values(one)
    elif origin is tuple and inner[-1] is ...:
        some = list(itertools.islice(values(inner[0]), 3))
        yield from (tuple(some[:1]), tuple(some), (*some, *some))
    elif origin is tuple:
        yield from zip(*map(values, inner), strict=False)
    else:
        yield from {bool: (True, False), int: (7, -3, 0, 10**12), type(None): (None,),
                    float: (0.1 + 0.2, -1e-05, -120.0, 1e300, 3.0),
                    str: ("two words", "it's \"so\"", "x=1", "$HOME *"),
                    Path: (Path("a folder/x y"), Path("*.json"), Path("-odd"))}[hint]


def positional(hint):
    return "Positional" in str(getattr(hint, "__metadata__", ""))


@pytest.mark.parametrize("name", [*KINDS, *TRAIN])
def test_every_option_is_written_so_that_it_is_read_back(name):
    kind = (KINDS | TRAIN)[name]
    hints = get_type_hints(kind, include_extras=True)
    needed = {f.name: next(v for v in values(hints[f.name]) if v not in (None, ()))
              for f in dataclasses.fields(kind) if f.default is dataclasses.MISSING}
    asked, all_odd = [kind(**needed)], {}
    for field in dataclasses.fields(kind):
        odd = [v for v in values(hints[field.name]) if v is not None]
        if positional(hints[field.name]):  # a word of its own cannot begin like an option
            odd = [v for v in odd if "-odd" not in str(v)]
        asked += [dataclasses.replace(asked[0], **{field.name: v}) for v in odd]
        all_odd[field.name] = odd[-1]
    asked.append(dataclasses.replace(asked[0], **all_odd))
    for args in asked:
        known, found = parsed(command.line(name, args))
        assert name.startswith(known)
        assert type(found) is kind
        assert command.figures(found) == command.figures(args)


@pytest.mark.parametrize("words", [
    "evaluate grid 'my sets/3 5.jsonl' --planner exact --planner greedy --time-limit 0.1 --alone",
    "evaluate sets 3x5 5x20 --policy any_team --policy 'other one' --limit 5 --best-of 4 --seed 3",
    "evaluate execution --site mare flat --loop closed open --mode async --slow 0.5",
    "evaluate slopes --kind wheeled --degrees 15 20.5 --roughness 0",
    "evaluate soil --soil dense nominal",
    "evaluate paces --kind wheeled --soil loose --degrees 0 6",
    "evaluate traverse --kind wheeled --ground regolith --soil dense",
    "evaluate execution --ground regolith --fields rigid --mode clock --planner exact",
    "bench physics --ground rigid regolith",
    "bench physics --threads 1 2 --worlds 1 --compilation",
    "bench train pi_5t --jaxmarl 'Jax MARL' --repeats 3",
    "rollout --from runs/x/report.json --mission 17 --contender 'open exact'",
    "rollout outpost --planner exact --mode async",
    "site --centre -120 -35.5 --dem 'the moon.tif' --detrend --no-detail",
    "train compare runs/a runs/b --label GRU --label 'no memory'",
    "train imitate quick --rounds 10 --begin any_team_imitated",
    "train guide --rounds 10 --population 8",
    "train refine any_team_imitated --reward paper --beside runs/a --beside runs/b",
])
def test_a_line_in_order_is_written_as_it_was(words):
    name, args = parsed(f"moonteam {words}")
    name = " ".join(words.split()[:2]) if name == "train" else name
    line = command.line(name, args)
    assert sorted(shlex.split(line)[1:]) == sorted(shlex.split(words))
    assert parsed(line)[1] == args


@pytest.mark.parametrize("words", ["", "--rounds 30 --hyper.epochs 2 --spec.layers 2 --seed 5"])
def test_a_preset_of_macro_decisions_is_written_by_what_differs_from_it(words):
    _, args = parsed(f"moonteam train quick {words}")
    line = command.line("train quick", args, train.parse(["quick"]))
    assert parsed(line)[1] == args
    assert line == f"moonteam train quick {words}".strip()


@pytest.mark.parametrize("words", [
    "", "--seed 5 --size 12 10 --bootstrap.updates 50 --refinement.weights.SC 0.5",
    "--no-memory --literal-step-cost --precision bfloat16 --stop-on-collapse",
    "--no-stop-on-collapse --begin 'runs/the first/checkpoints/00001000'",
])
def test_a_preset_of_train_is_written_by_what_differs_from_it(words):
    _, args = parsed(f"moonteam train small {words}")
    usual = train.parse(["small"])
    line = command.line("train small", args, usual)
    assert parsed(line)[1] == args
    assert len(line) <= len(f"moonteam train small {words}")


def test_what_no_figure_depends_on_is_left_out():
    words = "rollout demo --no-video --viewer --json --out runs/x --seed 3"
    assert command.line("rollout", parsed(f"moonteam {words}")[1]) == (
        "moonteam rollout demo --seed 3")
    assert command.line("evaluate timing", KINDS["evaluate timing"](markdown=True)) == (
        "moonteam evaluate timing")


@dataclasses.dataclass(frozen=True)
class Inner:
    """Of Odd."""

    on: bool = True
    weights: tuple[float, ...] = (1.0,)


@dataclasses.dataclass(frozen=True)
class Odd(options.Reported):
    """All that tyro is asked for anywhere, in one."""

    some: tyro.conf.Positional[tuple[str, ...]]
    """Required, before the options."""
    source: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    flat: Annotated[Inner, tyro.conf.arg(name="")] = Inner()
    inner: Inner = dataclasses.field(default_factory=Inner)
    again: options.Many[tuple[str, ...]] = ()
    where: Aside[int] = 0


def test_names_groups_flags_and_repeats():
    args = Odd(("a b", "c"), Path("r s"), Inner(False), Inner(False, (-1.0, 2.0)), ("-x", "y"),
               where=3, json=True)
    line = command.line("odd", args)
    assert line == ("moonteam odd 'a b' c --from 'r s' --no-on --inner.no-on "
                    "--inner.weights -1 2 --again=-x --again y")
    found = options.parse(Odd, "odd", shlex.split(line)[2:])
    assert found == dataclasses.replace(args, where=0, json=False)


@pytest.mark.parametrize("name", KINDS)
def test_inherited_options_keep_their_help(name, capsys):
    with pytest.raises(SystemExit):
        cli.main([*name.split(), "--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for base, words in ((options.Printed, "--json Print one JSON document and nothing else."),
                        (options.Reported, "--markdown Print the tables as Markdown, with"),
                        (options.Saved, "Folder to write files to; without it nothing is written."),
                        (options.Limited, "Only the first so many scenarios of a set."),
                        (options.Resumable, "--resume Go on with the run in the folder;"),
                        (options.Seeded, "--seed INT Seed of everything random. (default: 0)")):
        assert (words in shown) == issubclass(KINDS[name], base), (base, shown)


def without_times(document):
    """The figures: all but the provenance and what a clock said."""
    if isinstance(document, dict):
        return {key: without_times(value) for key, value in document.items()
                if key != "meta" and "seconds" not in key}
    return [*map(without_times, document)] if isinstance(document, list) else document


@pytest.mark.parametrize("words", [
    "evaluate grid 3x5 --limit 20 --planner exact --planner greedy --seed 2",
    "evaluate sets 2x3 --limit 10 --best-of 4 --seed 3",
    "evaluate slopes --kind wheeled --degrees 12 --roughness 0 --count 2 --seed 1",
])
def test_the_printed_command_gives_the_same_figures(words, capsys):
    assert cli.main([*words.split(), "--json"]) == 0
    first = json.loads(capsys.readouterr().out)
    again = shlex.split(first["meta"]["command"])[1:]
    assert cli.main([*again, "--json"]) == 0
    assert without_times(json.loads(capsys.readouterr().out)) == without_times(first)
    assert str(without_times(first)).count("0.") > 1  # figures there are
