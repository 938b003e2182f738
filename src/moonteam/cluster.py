"""Pieces of work on the machines of a Ray cluster; see docs/cluster.md.

A piece is a pure function of what it holds, so that a worker that is killed costs time alone: Ray
gives the piece to another. Nothing here touches a file; what comes back is the caller's to keep.
Ray is imported when a cluster is asked for, and at no other time.
"""

from __future__ import annotations

import importlib
import os
import pickle
import re
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple, TypeVar

from moonteam import compilation, interrupts
from moonteam.errors import InputError
from moonteam.version import __version__

R = TypeVar("R")

LOCAL = "ray"
"""The word for a cluster of this machine's cores, begun and ended with the command."""
RETRIES = 3
"""Times that a piece is given to another worker when its own is lost."""
LARGEST = 8
"""Things that are cut into one piece at most: what a killed driver has to do again."""
_STORE = 200 * 2**20  # bytes of Ray's object store on this machine: pieces are small
_ANSWER = 5.0  # s in which a host must answer
_HEALTHY = 30.0  # s in which what answered must say that it is a cluster
_JOIN = "import sys, ray; ray.init(sys.argv[1], log_to_driver=False, logging_level='ERROR')"
_OURS = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
         "RAY_worker_niceness": "0"}
_JAX = {"JAX_ENABLE_X64": "0", "JAX_PLATFORMS": "cpu"}


class _Setup(NamedTuple):
    """What a worker needs to know before it reads a piece."""

    version: str
    folder: str  # of the command, where workers have it too: files may be named from there
    at_once: bool  # see `compilation.call_at_once`
    devices: str  # JAX_NUM_CPU_DEVICES; empty: as it is

    def make(self) -> None:
        """Prepares this process, which is a worker's. Raises InputError for another version."""
        if self.version != __version__:
            raise InputError("--on", f"a worker has moonteam {__version__}, here it is "
                             f"{self.version}; install the same on all machines")
        os.environ.update(_JAX)
        if self.devices:
            os.environ["JAX_NUM_CPU_DEVICES"] = self.devices
        if os.path.isdir(self.folder):
            os.chdir(self.folder)
        compilation.enable_cache()
        if self.at_once:
            compilation.call_at_once()


class _Refused(NamedTuple):
    """An InputError, which says of itself less than what it is made from."""

    source: str
    problem: str
    key: str


def _answered(setup: _Setup | None, box: bytes, work: Callable[..., Any]) -> bytes:
    """In a worker: what came of a function and its arguments, both ways as bytes.

    `setup` is None where the process is prepared.
    """
    try:
        if setup is not None:
            setup.make()
        answer = work(*pickle.loads(box))
    except InputError as error:
        answer = _Refused(error.source, error.problem, error.key)
    return pickle.dumps(answer)


def _called(work: Callable[..., Any], arguments: tuple) -> Any:
    return work(*arguments)


def _piece(setup: _Setup, box: bytes) -> bytes:
    """In a worker: what came of a piece, a function and its arguments."""
    return _answered(setup, box, _called)


class _Holder:
    """In a worker: something that stays there between two calls."""

    def __init__(self, setup: _Setup, box: bytes):
        self._setup: _Setup | None = setup
        self._box, self._thing = box, None

    def call(self, method: str, box: bytes) -> bytes:
        """What a method of the thing answers, which is made at the first call."""
        def work(*arguments: Any) -> Any:
            if self._thing is None:
                make, given = pickle.loads(self._box)
                self._thing = make(*given)
            return getattr(self._thing, method)(*arguments)

        setup, self._setup = self._setup, None
        return _answered(setup, box, work)


class Held:
    """A thing that lives in a worker of its own; a new one is made where that is lost."""

    def __init__(self, actor: Any):
        self._actor = actor

    def call(self, method: str, *arguments: Any) -> Any:
        """Asks for a method's answer; `Cluster.value` of what is returned is the answer."""
        return self._actor.call.remote(method, _packed(arguments))


class Cluster:
    """Workers on one machine or many; `cpus` is how many pieces of one CPU run at a time.

    Args:
      ray: the module, connected.
      name: what the user called it.
      at_once: whether workers run JAX's programs on the thread that calls them.
    """

    def __init__(self, ray: Any, name: str, at_once: bool = False):
        self._ray, self.name = ray, name
        self._setup = _Setup(__version__, os.getcwd(), at_once, "")
        self.cpus = int(ray.cluster_resources().get("CPU", 0))
        if self.cpus < 1:
            raise InputError("--on", f"{name} has no CPUs to compute on")

    def size(self, count: int) -> int:
        """How many of `count` like things make a piece: several pieces a worker, none large."""
        return max(1, min(LARGEST, -(-count // (4 * self.cpus))))

    def done(self, work: Callable[..., R], pieces: Sequence[tuple]) -> Iterator[tuple[int, R]]:
        """The number and result of each piece, as they come; a piece is `work`'s arguments.

        Raises InputError as `work` does, or if one piece has lost all its workers.
        """
        remote = self._ray.remote(num_cpus=1, max_retries=RETRIES)(_piece)
        waiting = {remote.remote(self._setup, _packed((work, piece))): number
                   for number, piece in enumerate(pieces)}
        while waiting:
            for ready in self.ready(list(waiting)):
                yield waiting.pop(ready), self.value(ready)

    def hold(self, make: Callable[..., Any], *arguments: Any, cpus: int) -> Held:
        """`make` of the arguments, in a worker of its own with so many CPUs and JAX devices.

        Raises InputError if no machine has so many.
        """
        most = max((int(node["Resources"].get("CPU", 0)) for node in self._ray.nodes()
                    if node["Alive"]), default=0)
        if most < cpus:
            raise InputError("--on", f"a run takes {cpus} CPUs of one machine, as it has here, and "
                             f"{self.name} has machines of at most {most}; "
                             f"JAX_NUM_CPU_DEVICES={max(most, 1)} makes it take fewer")
        kind = self._ray.remote(num_cpus=cpus, max_restarts=RETRIES, max_task_retries=RETRIES,
                                max_concurrency=2)(_Holder)
        setup = self._setup._replace(devices=str(cpus))
        return Held(kind.remote(setup, _packed((make, arguments))))

    def drop(self, held: Held) -> None:
        """Ends a thing and frees its CPUs."""
        self._ray.kill(held._actor)

    def ready(self, asked: Sequence[Any], seconds: float | None = None) -> list[Any]:
        """Those of what was asked for that are answered; waits for one, or so long."""
        return self._ray.wait(list(asked), num_returns=1, timeout=seconds)[0]

    def value(self, asked: Any) -> Any:
        """An answer. Raises InputError as its work does, or if its workers are lost."""
        errors = self._ray.exceptions
        try:
            answer = pickle.loads(self._ray.get(asked))
        except errors.RayTaskError as error:
            if lacking := re.search(r"No module named '([\w.]+)'", str(error)):
                raise InputError("--on", f"a worker has no module {lacking[1]}; install moonteam, "
                                 "and what the command needs, on all machines") from None
            raise
        except errors.RayError as error:
            raise InputError("--on", f"{self.name}: a piece has lost {RETRIES + 1} workers: "
                             f"{_first_line(error)}") from None
        if isinstance(answer, _Refused):
            raise InputError(*answer)
        return answer


@contextmanager
def cluster(on: str, at_once: bool = False) -> Iterator[Cluster | None]:
    """The cluster that `--on` asks for, for as long as it is needed; None without the option.

    JAX computes on CPUs then, in the workers and here. Raises InputError if Ray is not installed,
    or nothing answers.
    """
    if not on:
        yield None
        return
    address = _checked(on)
    os.environ.update({name: os.environ.get(name, value) for name, value in _OURS.items()})
    with interrupts.kept():  # Ray answers SIGTERM itself
        try:
            import ray
        except ImportError:
            raise InputError("--on", "needs Ray, which is not installed: pip install "
                             "'moonteam[ray]'") from None
        import jax

        jax.config.update("jax_platforms", "cpu")
        _connect(ray, on, address)
    try:
        yield Cluster(ray, on, at_once)
    finally:
        ray.shutdown()


def _checked(on: str) -> tuple[str, int] | None:
    """Host and port; None for this machine's own cores."""
    if on == LOCAL:
        return None
    host, colon, port = on.removeprefix("ray://").rpartition(":")
    if not (host and colon and port.isdecimal() and int(port) < 2**16):
        raise InputError("--on", f"{on!r} is not allowed; ray (the cores of this machine), "
                         "HOST:PORT of a cluster that this machine is part of, or ray://HOST:PORT")
    return host, int(port)


def _say_on_stderr() -> None:
    """Ray prints what befell a worker on standard output, where a command's JSON document is."""
    with suppress(ImportError, AttributeError):
        worker: Any = importlib.import_module("ray._private.worker")
        print_to = worker.print_to_stdstream
        worker.print_to_stdstream = lambda data, *rest, **named: print_to(
            data | {"is_err": True}, *rest, **named)


def _connect(ray: Any, on: str, address: tuple[str, int] | None) -> None:
    """Joins the cluster, or begins one. Raises InputError."""
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None:
        quiet |= {"num_cpus": compilation.cores(), "include_dashboard": False,
                  "object_store_memory": _STORE}
    else:
        _check_answer(on, address)
    _say_on_stderr()
    try:
        ray.init("local" if address is None else on, **quiet)
    except (ConnectionError, ImportError, OSError, RuntimeError, ValueError) as error:
        if _TOKEN.search(str(error)):
            raise InputError("--on", f"{on} wants its token: {_BRINGS}") from None
        # A client is not told that it is its token.
        perhaps = f"; if it wants its token: {_BRINGS}" if on.startswith("ray://") else ""
        raise InputError("--on", f"{on}: {_first_line(error)}{perhaps}") from None


_TOKEN = re.compile("unauthenticated|auth.?token", re.IGNORECASE)
_BRINGS = ("set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN to what `ray get-auth-token` says where it "
           "was started, or have that in ~/.ray/auth_token")


def _check_answer(on: str, address: tuple[str, int]) -> None:
    """Raises InputError if no cluster answers there; Ray itself would ask for minutes."""
    start = ("start it there: ray start --head (port 6379; clients: ray://, port 10001), and check "
             "host, port and firewall")
    try:
        socket.create_connection(address, _ANSWER).close()
    except OSError as error:
        raise InputError("--on", f"nothing answers at {on} ({error.strerror or error}); {start}"
                         ) from None
    if on.startswith("ray://"):
        return
    try:
        tried = subprocess.run([sys.executable, "-c", _JOIN, on], capture_output=True, text=True,
                               timeout=_HEALTHY, check=False)
    except subprocess.TimeoutExpired:
        raise InputError("--on", f"what answers at {on} is no Ray cluster; {start}") from None
    if tried.returncode and _TOKEN.search(tried.stderr):
        raise InputError("--on", f"{on} wants its token: {_BRINGS}")


def _first_line(error: BaseException) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()),
                type(error).__name__)


def _packed(thing: Any) -> bytes:
    """Bytes of a thing; the code of a user's FILE.py goes along."""
    from ray import cloudpickle

    for name, module in list(sys.modules.items()):
        if name.startswith("moonteam_plugin_"):
            cloudpickle.register_pickle_by_value(module)
    return cloudpickle.dumps(thing)
