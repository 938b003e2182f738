"""The `moonteam` command: a table of subcommands, each loaded only when it is asked for.

A command module holds `Args`, a frozen dataclass whose docstring is the help text and
whose fields tyro reads, `run(args) -> int`, which returns the exit code, and, where it writes into
a folder `--out`, `FILES`: their names, for which the folder is held while it runs.
Exit codes: 0 done, 1 ran but the mission failed, 2 bad input or usage, 130 interrupted by Ctrl-C
or SIGTERM (`interrupts`), 141 whoever read the output (`| head`) went away.
"""

from __future__ import annotations

import codecs
import errno
import importlib
import io
import logging
import os
import sys
from typing import Any

from moonteam import compilation, interrupts
from moonteam.errors import InputError, meant, not_one_of
from moonteam.version import __version__

COMMANDS = {
    "train": ("training.commands.train", "train a grid policy from a preset"),
    "plan": ("moonteam.commands.plan", "plan a scenario and print the schedule"),
    "replay": ("moonteam.commands.replay", "the grid env's trace of a list of actions"),
    "rollout": ("sim2grid.commands.rollout", "run a mission in physics: video and report"),
    "evaluate grid": ("moonteam.commands.evaluate_grid", "planners side by side on a set"),
    "evaluate sets": (
        "moonteam.commands.evaluate_sets", "one policy over all bundled sets, one row a set"),
    "evaluate replanning": (
        "moonteam.commands.evaluate_replanning", "5 + 5 targets, new ones while under way"),
    "evaluate unfolding": (
        "moonteam.commands.evaluate_unfolding", "missions in which not everything is known"),
    "evaluate peers": (
        "moonteam.commands.evaluate_peers", "our planners beside what others published"),
    "evaluate timing": ("moonteam.commands.evaluate_timing", "planning time against size"),
    "evaluate execution": (
        "sim2grid.commands.evaluate_execution",
        "many missions in physics: success, cost and failures"),
    "evaluate sensitivity": (
        "sim2grid.commands.evaluate_sensitivity",
        "success and seconds against slope, friction, noise"),
    "evaluate soak": (
        "sim2grid.commands.evaluate_soak", "unlike missions in physics, memory, failures"),
    "evaluate preference": (
        "moonteam.commands.evaluate_preference", "a policy's trade-off of time and effort"),
    "evaluate traverse": (
        "moonteam.commands.evaluate_traverse", "each kind of robot on its own over a site"),
    "evaluate slopes": (
        "moonteam.commands.evaluate_slopes", "how steep each kind of robot can go"),
    "evaluate soil": (
        "moonteam.commands.evaluate_soil", "the regolith model beside published experiments"),
    "evaluate paces": (
        "moonteam.commands.evaluate_paces", "how soil slows each kind of robot, by slope"),
    "check robot": (
        "moonteam.commands.check_robot", "whether a kind of robot keeps what all must keep"),
    "check planner": (
        "moonteam.commands.check_planner", "whether a planner keeps what all must keep"),
    "export": ("moonteam.commands.export", "a policy as an ONNX file that runs without JAX"),
    "site": ("moonteam.commands.site", "make, import and preview lunar terrain"),
    "bench grid": ("moonteam.commands.bench_grid", "planner and grid env speed"),
    "bench travel": ("moonteam.commands.bench_travel", "travel in seconds: speed and exactness"),
    "bench train": ("training.commands.bench_train", "training throughput"),
    "bench physics": ("moonteam.commands.bench_physics", "physics steps per second"),
    "bench execution": ("sim2grid.commands.bench_execution", "missions in physics per second"),
    "testsets": ("moonteam.commands.testsets", "make the scenario sets, with their optima"),
    "testsets import": (
        "moonteam.commands.testsets_import", "others' instances as a set by the clock"),
    "doctor": ("moonteam.commands.doctor", "what this machine can do"),
}


HELP = ("-h", "--help", "help")


def usage(group: str = "") -> str:
    """The overview that `moonteam --help` prints, or `moonteam GROUP --help`."""
    head = " ".join(["moonteam", *filter(None, [group])])
    lines = [f"moonteam {__version__}: plan for a team of unlike robots on the Moon, "
             "and prove the plan in physics.", "", f"usage: {head} COMMAND [options]", ""]
    lines += [f"  {name:<20} {line}" for name, (_, line) in COMMANDS.items()
              if not group or name in members(group)]
    return "\n".join([*lines, "", f"{head} COMMAND --help shows options and examples."])


def members(group: str) -> list[str]:
    """The commands whose first word of two it is."""
    return [name for name in COMMANDS if name.startswith(group + " ")]


def find_command(words: list[str]) -> tuple[str, list[str]]:
    """Splits the command's name (one or two words) from its arguments."""
    for count in (2, 1):
        name = " ".join(words[:count])
        if len(words) >= count and name in COMMANDS:
            return name, words[count:]
    first, second = [*words[:2], ""][:2]
    if group := members(first):
        near = meant(second, [name.split()[1] for name in group], f"{first} ")
    else:
        near = meant(first, [name.split()[0] for name in COMMANDS])
    raise InputError(" ".join(["moonteam", *words[:1 + bool(group)]]),
                     f"no such command; {near}one of: " + ", ".join(group or COMMANDS))


def parse(name: str, words: list[str]) -> Any:
    """The arguments of the command `name`, read from the words after it. Raises InputError."""
    module = importlib.import_module(COMMANDS[name][0])
    if hasattr(module, "parse"):  # a command whose first word decides its defaults
        return module.parse(words)
    from moonteam.commands import options

    return options.parse(module.Args, name, words)


def main(argv: list[str] | None = None) -> int:
    """Runs one command; returns its exit code. Without `argv` the process is the command's own."""
    if argv is not None:
        return _guarded(argv)
    with interrupts.handled():
        code = _guarded(sys.argv[1:])
        if interrupts.asked():
            interrupts.leave(code)
    return code


def _guarded(words: list[str]) -> int:
    """The exit code, whatever is raised."""
    _mend_streams()
    try:
        try:
            return _run(words)
        finally:
            sys.stdout.flush()  # here, where a reader that went away is still caught
    except InputError as error:
        print(f"moonteam: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return interrupts.say()
    except BrokenPipeError:
        # What is still in the buffer has no reader: Python must not try to write it at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except Exception as error:
        if interrupts.asked():
            return interrupts.say()
        problem = _unwritable(error) or _surroundings()
        if problem is None:
            raise
        print(f"moonteam: {problem}", file=sys.stderr)
        return 2


def _mend_streams() -> None:
    """Lets any text out, whatever the locale: a character that it lacks is written as JSON would.

    A stream that was closed before we began goes nowhere.
    """
    codecs.register_error("moonteam", _escaped)
    for name in ("stdin", "stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            # The file keeps its number from what is opened next.
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w",  # noqa: SIM115
                                    encoding="utf-8"))
        elif name != "stdin" and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="moonteam")


def _escaped(error: UnicodeError) -> tuple[str, int]:
    """Of a text that cannot be encoded, in place of what cannot, and where to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    wide = error.object[error.start:error.end].encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{wide[k]:02x}{wide[k + 1]:02x}" for k in range(0, len(wide), 2)), error.end


UNWRITABLE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR,
              errno.EEXIST, errno.ENAMETOOLONG, errno.EFBIG, errno.EISDIR, errno.ELOOP, errno.EIO)
RENDERERS = ("egl", "osmesa", "glfw", "disable")
"""What MUJOCO_GL may be, for us; mujoco knows other words for the same."""


def _unwritable(error: Exception) -> str | None:
    """One line of an error that is the disk's or its permissions', with the file if it is known."""
    if not isinstance(error, OSError) or error.errno not in UNWRITABLE:
        return None
    where = error.filename2 or error.filename
    return f"{where}: {error.strerror}" if where else str(error.strerror)


def _surroundings() -> str | None:
    """One line of what in the environment lets nothing run; None where all is well with it."""
    renderer, platforms = os.environ.get("MUJOCO_GL", ""), os.environ.get("JAX_PLATFORMS", "")
    if renderer and "mujoco" not in sys.modules and renderer.lower() not in RENDERERS:
        return f"MUJOCO_GL: {not_one_of(renderer, RENDERERS)}"
    if platforms and "jax" in sys.modules and not compilation.devices():
        return (f"JAX_PLATFORMS: there is no device of {platforms!r} here; unset it, or set it to "
                "cpu")
    return None


def _run(words: list[str]) -> int:
    # It says twice that its cache cannot be written, which changes nothing.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    # With 64 bits JAX draws other numbers, and the same seed would give other results.
    os.environ["JAX_ENABLE_X64"] = "0"
    if not words or words[0] in HELP:
        print(usage())
        return 0 if words else 2
    if members(words[0]) and words[0] not in COMMANDS and words[1:2] and words[1] in HELP:
        print(usage(words[0]))
        return 0
    if words[0] == "--version":
        print(__version__)
        return 0
    name, rest = find_command(words)
    module = importlib.import_module(COMMANDS[name][0])
    args = parse(name, rest)
    from moonteam.commands import options

    with options.keeping(args, getattr(module, "FILES", ())):
        return module.run(args)


if __name__ == "__main__":
    sys.exit(main())
