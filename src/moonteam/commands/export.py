"""`moonteam export`: a policy as an ONNX file, for robots that do not carry JAX."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from moonteam import compilation, files, outputs, paths
from moonteam.commands.options import Forced, Printed, Seeded
from moonteam.errors import InputError
from moonteam.report.command import Aside

if TYPE_CHECKING:
    from moonteam.policies.policy import Policy

TOLERANCE = 1e-3


@dataclass(frozen=True)
class Args(Seeded, Forced, Printed):
    """Write a policy as a self-contained ONNX file and hold it against the original.

    The file takes any number of robots and targets where the policy does; its metadata say
    what the inputs are and which file (moonteam/policies/export/onboard.py, onboard_pointer.py)
    builds them with NumPy alone. The largest difference from the original, on states that it
    visits, is printed: of log-probabilities, or logits of a recurrent policy; of a pointing one, of
    the logits of all robots and targets, closed ones too, where choices settled at events of
    missions by the clock are compared instead of actions. Needs the extra
    `export` (onnx, onnxruntime). Exit code 1 if the two differ.

    Examples:
      moonteam export any_team
      moonteam export runs/any_team-0/policy.safetensors --out any_team.onnx --json
    """

    policy: tyro.conf.Positional[str]
    """Policy file (.safetensors) or the name of a bundled policy."""
    out: Aside[Path | None] = None
    """The file to write; the policy's name with .onnx in this folder if not given."""
    states: int = 1000
    """States to compare on, at least."""


def model_of(policy: Policy) -> bytes:
    """The policy as an ONNX model. Raises InputError where the extra is missing."""
    try:
        import onnxruntime  # noqa: F401

        from moonteam.policies.export import onnx_graph, pointer_graph
    except ImportError as error:
        raise InputError("moonteam export", f"{error.name} is missing; install the extra: "
                         "pip install 'moonteam[export]'") from None
    from moonteam.policies.brain import EntityBrain, PointerBrain, RecurrentBrain

    if isinstance(policy.brain, EntityBrain):
        return onnx_graph.entity_graph(policy.source, policy.brain.spec).SerializeToString()
    if isinstance(policy.brain, PointerBrain):
        return pointer_graph.pointer_graph(policy.source, policy.brain.spec).SerializeToString()
    assert isinstance(policy.brain, RecurrentBrain)
    return onnx_graph.recurrent_graph(policy.source, policy.brain.spec).SerializeToString()


def run(args: Args) -> int:
    """Exports and compares; 1 if the file does not decide as the policy does."""
    if args.states < 1:
        raise InputError("--states", f"{args.states} is not allowed; at least 1")
    path = paths.find(args.policy, "policies", ".safetensors")
    out = args.out or Path(f"{path.stem}.onnx")
    if out.suffix != ".onnx":
        raise InputError("--out", f"{out} does not end in .onnx")
    with outputs.file(out, args.force):
        return _export(args, path, out)


def _export(args: Args, path: Path, out: Path) -> int:
    compilation.enable_cache()
    from moonteam.evaluation import exported
    from moonteam.policies.policy import Policy

    policy = Policy.load(path)
    model = model_of(policy)
    found = exported.compare(policy, model, args.states, args.seed)
    with files.replacing(out) as temporary:
        temporary.write_bytes(model)
    good = found.largest <= TOLERANCE
    if args.json:
        print(files.dump_json({"file": str(out), "bytes": len(model), "kind": policy.source.kind,
                               "tolerance": TOLERANCE, **found.document()}))
    else:
        print(f"{out}: {len(model):,} bytes; on {found.states} states that the policy visits the "
              f"largest difference is {found.largest:.2g}, and {found.agree:.2%} of the "
              f"{'choices' if policy.source.kind == 'pointer' else 'actions'} are the same")
        if not good:
            print(f"more than {TOLERANCE:g}: the file does not decide as the policy does")
    return 0 if good else 1
