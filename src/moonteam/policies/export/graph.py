"""What the graphs of all kinds of networks are written with: nodes, layers, the model around them.

Legend: B batch, N agents, M targets, E = N + M tokens, D width, K heads.
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
from onnx import ModelProto, TensorProto, checker, helper, numpy_helper

from moonteam.policies.attention import FAR
from moonteam.policies.entity import EntitySpec
from moonteam.policies.pointer import PointerSpec
from moonteam.policies.policy_file import PolicyFile
from moonteam.version import __version__

OPSET, IR = 17, 9
LAST = np.iinfo(np.int64).max
_EPSILON = 1e-6  # of flax's layer norm

INT, FLOAT, BOOL = TensorProto.INT32, TensorProto.FLOAT, TensorProto.BOOL


class Graph:
    """Nodes in the making; every method returns the name of its result."""

    def __init__(self, params: Any, outer: Graph | None = None):
        """`outer`: of the body of a loop, the graph around it, which keeps the constants."""
        self.params, self.nodes, self.letter = params, [], "b" if outer else "v"
        self.constants: dict[str, TensorProto] = outer.constants if outer else {}

    def __call__(self, kind: str, *inputs: str, outputs: int = 1, **attributes: Any) -> Any:
        """A node; the name of its result, or a list of several."""
        names = [f"{self.letter}{len(self.nodes)}_{i}" for i in range(outputs)]
        self.nodes.append(helper.make_node(kind, inputs, names, **attributes))
        return names if outputs > 1 else names[0]

    def constant(self, value: Any, kind: Any = np.float32) -> str:
        """A number or array; equal ones are kept once."""
        array = np.asarray(value, kind)
        key = f"c_{array.dtype}_{array.shape}_{array.tobytes().hex()}"
        if array.size > 8:
            key = f"w{len(self.constants)}"
        self.constants.setdefault(key, numpy_helper.from_array(array, key))
        return key

    def ints(self, *values: int) -> str:
        """Int64 numbers, as axes and ends are given."""
        return self.constant(values, np.int64)

    def number(self, value: str) -> str:
        """As floats."""
        return self("Cast", value, to=FLOAT)

    def add(self, a: str, b: str) -> str:
        """a + b."""
        return self("Add", a, b)

    def over(self, value: str, scale: float) -> str:
        """Divided by a number."""
        return self("Div", value, self.constant(scale))

    def wide(self, value: str, *axes: int) -> str:
        """With new axes of length 1."""
        return self("Unsqueeze", value, self.ints(*axes))

    def join(self, *values: str, axis: int = -1) -> str:
        """Along an axis that there is."""
        return self("Concat", *values, axis=axis)

    def total(self, value: str, axis: int, keep: bool = False) -> str:
        """Sum."""
        return self("ReduceSum", value, self.ints(axis), keepdims=int(keep))

    def least(self, value: str, axis: int) -> str:
        """Minimum."""
        return self("ReduceMin", value, axes=[axis], keepdims=0)

    def part(self, value: str, axis: int, start: str, end: str) -> str:
        """From start to before end, int64 [1]."""
        return self("Slice", value, start, end, self.ints(axis))

    def most(self, value: str, axis: int) -> str:
        """Maximum."""
        return self("ReduceMax", value, axes=[axis], keepdims=0)

    def both(self, a: str, b: str) -> str:
        """a and b."""
        return self("And", a, b)

    def flipped(self, value: str) -> str:
        """The last two of three axes exchanged."""
        return self("Transpose", value, perm=[0, 2, 1])

    def dense(self, params: Any, value: str) -> str:
        """A linear layer."""
        out = self("MatMul", value, self.constant(params["kernel"]))
        return self.add(out, self.constant(params["bias"])) if "bias" in params else out

    def norm(self, params: Any, value: str) -> str:
        """Layer norm of the last axis."""
        return self("LayerNormalization", value, self.constant(params["scale"]),
                    self.constant(params["bias"]), axis=-1, epsilon=_EPSILON)

    def gelu(self, x: str) -> str:
        """The form by tanh, flax's default."""
        cube = self("Mul", self("Mul", x, x), self("Mul", x, self.constant(0.044715)))
        inner = self("Mul", self.add(x, cube), self.constant(math.sqrt(2 / math.pi)))
        half = self("Mul", x, self.constant(0.5))
        return self("Mul", half, self.add(self("Tanh", inner), self.constant(1.0)))


def by_role(g: Graph, pairs: str, ends: dict[str, tuple[str, str]]) -> str:
    """[B, E, E, layers * heads] biases, one reading for each pair of roles."""
    rows = []
    for own, (start, end) in ends.items():
        row = g.part(pairs, 1, start, end)
        parts = [g.dense(g.params[f"bias_{own}_{other}"], g.part(row, 2, *span))
                 for other, span in ends.items()]
        rows.append(g.join(*parts, axis=2))
    return g.join(*rows, axis=1)


def block(g: Graph, spec: EntitySpec | PointerSpec, params: Any, x: str, bias: str,
          mask: str) -> str:
    """A pre-norm attention block; bias [B, K, E, E], mask [B, 1, 1, E]."""
    size = spec.width // spec.heads
    qkv = g.dense(params["qkv"], g.norm(params["LayerNorm_0"], x))
    qkv = g("Reshape", qkv, g.ints(0, 0, spec.heads, 3 * size))
    q, k, v = g("Split", qkv, g.ints(size, size, size), outputs=3, axis=3)
    q, v = (g("Transpose", part, perm=[0, 2, 1, 3]) for part in (q, v))
    k = g("Transpose", k, perm=[0, 2, 3, 1])
    logits = g.add(g("Mul", g("MatMul", q, k), g.constant(size**-0.5)), bias)
    logits = g("Where", mask, logits, g.constant(-FAR))
    mixed = g("Transpose", g("MatMul", g("Softmax", logits, axis=-1), v), perm=[0, 2, 1, 3])
    x = g.add(x, g.dense(params["out"], g("Reshape", mixed, g.ints(0, 0, spec.width))))
    y = g.gelu(g.dense(params["up"], g.norm(params["LayerNorm_1"], x)))
    return g.add(x, g.dense(params["down"], y))


def model(g: Graph, policy: PolicyFile, given: list, made: list,
          **about: str) -> ModelProto:
    """The nodes as a checked model; `about` goes into its metadata."""
    graph = helper.make_graph(g.nodes, f"moonteam-{policy.kind}", given, made,
                              list(g.constants.values()))
    made_model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)],
                                   ir_version=IR, producer_name="moonteam",
                                   producer_version=__version__)
    helper.set_model_props(made_model, {
        "kind": policy.kind, "commit": policy.commit, "config": json.dumps(policy.config),
        "recipe": json.dumps(policy.recipe),
        "inputs": json.dumps({v.name: v.doc_string for v in given}), **about})
    checker.check_model(made_model, full_check=True)
    return made_model
