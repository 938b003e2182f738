"""The pointing network as an ONNX graph; see `onnx_graph` for why it is written node by node.

Inputs are the fields of `pointer.Outlook`, with symbolic dimensions `batch`, `agents`, `targets`
and `skills`; `onboard_pointer` builds them. The team's value, wanted in training alone, is left
out. Names and order of the computation follow `pointer.py`, to which tests hold the results.

Legend: B batch, N agents, M targets, E = N + M tokens, S skills, K heads.
"""

from __future__ import annotations

from typing import Any

from onnx import ModelProto, helper

from moonteam.errors import InputError
from moonteam.grid.macro.types import LONG
from moonteam.policies.export.graph import BOOL, FLOAT, INT, LAST, Graph, block, by_role, model
from moonteam.policies.pointer import PointerSpec
from moonteam.policies.policy_file import PolicyFile

INPUTS: dict[str, tuple[int, tuple[str, ...], str]] = {
    "agents": (BOOL, ("agents",), "in the team"),
    "targets": (BOOL, ("targets",), "known and lacking somebody"),
    "free": (BOOL, ("agents",), "chooses now"),
    "spare": (FLOAT, ("agents",), "time until it is free, if it is bound"),
    "slow": (FLOAT, ("agents",), "log of its time between targets over the quickest's"),
    "travel": (FLOAT, ("agents", "targets"),
               f"time until it could be at the target; {LONG:g}: never"),
    "between": (FLOAT, ("targets", "targets"), "time between targets, by the quickest"),
    "goal": (BOOL, ("agents", "targets"), "bound to the target"),
    "has": (BOOL, ("agents", "skills"), "skills"),
    "lacks": (INT, ("targets", "skills"), "agents missing of each skill"),
    "either": (BOOL, ("targets",), "any of them will do"),
    "service": (FLOAT, ("targets",), "time that a coalition stays"),
    "ready": (FLOAT, ("targets",), "time before which it cannot start"),
    "left": (FLOAT, ("targets",), f"time until it lapses; {LONG:g}: never"),
    "after": (BOOL, ("targets", "targets"), "after[j, k]: j waits for k"),
    "home": (FLOAT, ("agents", "targets"), "time from the target home"),
    "preference": (FLOAT, (), "0 time .. 1 effort"),
}
"""Type, dimensions after the batch and meaning of each input, in this order; times are in units
of the mission, about 1 for a usual way, and at most `macro.types.LONG`."""


def _log1p(g: Graph, value: str) -> str:
    return g("Log", g.add(value, g.constant(1.0)))


def _some(g: Graph, value: str) -> str:
    """Bool: positive."""
    return g("Greater", value, g.constant(0.0))


def _tokens(g: Graph) -> tuple[str, str]:
    """[B, N, .] and [B, M, .] features of each entity by itself."""
    zero, long = g.constant(0.0), g.constant(LONG)
    team, still = g.number("agents"), g.number("targets")
    has, wanted = g.number(g.both("has", g.wide("agents", 2))), g.number("lacks")
    lacking = _some(g, wanted)
    demand = g.total(g("Mul", wanted, g.wide(still, 2)), 1)
    scarce = g("Div", demand, g("Max", g.total(has, 1), g.constant(1.0)))
    scarce = g.wide(scarce, 1)  # [B, 1, S]
    arrives = g.both(g("Less", "travel", long), g.wide("agents", 2))
    can = g.both(_some(g, g("MatMul", g.number("has"), g.flipped(g.number(lacking)))),
                 g.both(arrives, g.wide("targets", 1)))
    reach, able = g("Where", can, "travel", long), g.number(can)
    near = g.least(reach, 1)
    second = g.least(g("Where", g("Greater", reach, g.wide(near, 1)), reach, long), 1)
    brings = g.both(g.wide("has", 2), g.wide(arrives, 3))  # [B, N, M, S]
    times = g("Where", brings, g.wide("travel", 3), long)
    there = g.total(g.number(g("LessOrEqual", g.wide(times, 1), g.wide(times, 2))), 2)
    enough = g("GreaterOrEqual", there, g.wide(wanted, 1))
    each = g.least(g("Where", enough, times, long), 1)  # [B, M, S], when so many are there
    meet = g("Where", "either", near, g.most(g("Where", lacking, each, zero), 2))
    meet = g("Mul", meet, still)
    aim, after = g.number("goal"), g.number("after")
    moment = [_log1p(g, g.total(team, 1)), _log1p(g, g.total(still, 1)),
              _log1p(g, g.total(g.total(able, 2), 1)), "preference", g.most(meet, 1),
              g.over(g.total(meet, 1), 8.0), g.most(g("Where", "agents", "spare", zero), 1)]
    shared = g.wide(g.join(*(g.wide(part, 1) for part in moment)), 1)  # [B, 1, 7]

    def with_moment(rows: str, *parts: str) -> str:
        nothing = g.wide(g("Mul", rows, zero), 2)  # [B, rows, 1], to broadcast
        return g.join(*(g.wide(part, 2) for part in parts), g.add(nothing, shared))

    rare = g("Mul", has, scarce)
    agents = with_moment(
        team, "slow", "spare", g.number("free"), g.most(aim, 2), g.least(reach, 2),
        _log1p(g, g.total(able, 2)), g.over(g.total(has, 2), 2.0), _log1p(g, g.total(rare, 2)),
        g.most(rare, 2))
    targets = with_moment(
        still, g.over(g.total(wanted, 2), 2.0), g.over(g.total(g.number(lacking), 2), 2.0),
        g.number("either"), near, second, meet, _log1p(g, g.total(able, 1)), "service", "ready",
        g.most(g("Mul", aim, g.wide(team, 2)), 1),
        g("Exp", g("Neg", "left")), g("Exp", g.over("left", -4.0)),
        _log1p(g, g.total(g("Mul", after, g.wide(still, 1)), 2)),
        _log1p(g, g.total(g("Mul", after, g.wide(still, 2)), 1)),
        g.total(g("Where", lacking, scarce, zero), 2))
    return agents, targets


def _pairs(g: Graph) -> str:
    """[B, E, E, F] what token j is to token i."""
    has, asks = g.number("has"), g.number(_some(g, g.number("lacks")))
    aa = g("MatMul", has, g.flipped(has))
    am = g("MatMul", has, g.flipped(asks))  # [B, N, M]
    mm = g("MatMul", asks, g.flipped(asks))
    left = g("Sub", g.wide(g.total(asks, 2), 1), am)
    done = g("Or", g.wide("either", 1), g("LessOrEqual", left, g.constant(0.0)))
    covers = g.number(g.both(_some(g, am), done))
    none, nothing = (g("Mul", x, g.constant(0.0)) for x in (aa, mm))

    def whole(a: str, b: str, c: str, d: str) -> str:
        return g.join(g.join(a, b), g.join(c, d), axis=1)

    travel = whole(none, "travel", g.flipped("travel"), "between")
    goal, after = g.number("goal"), g.number("after")
    same = g("MatMul", goal, g.flipped(goal))
    columns = [
        travel, _log1p(g, g("Mul", travel, g.constant(4.0))),
        g("Exp", g("Mul", travel, g.constant(-2.0))), g("Exp", g("Mul", travel, g.constant(-8.0))),
        whole(aa, am, g.flipped(am), mm), whole(none, covers, g.flipped(covers), nothing),
        whole(same, goal, g.flipped(goal), after),
        whole(none, "home", g.flipped("home"), g.flipped(after))]
    return g.join(*(g.wide(column, 3) for column in columns))


def _point(g: Graph, spec: PointerSpec, x: str, pairs: str, spans: dict[str, Any]) -> None:
    """The output `logits`."""
    robots, goals = (g.part(x, 1, *spans[role]) for role in ("agent", "target"))
    query, key = g.dense(g.params["query"], robots), g.dense(g.params["key"], goals)
    between = g.part(g.part(pairs, 1, *spans["agent"]), 2, *spans["target"])
    bias = g("Squeeze", g.dense(g.params["point_bias"], between), g.ints(3))
    match = g("Mul", g("MatMul", query, g.flipped(key)), g.constant(spec.width**-0.5))
    both = [g.add(match, bias), g.dense(g.params["stay"], robots)]
    g.nodes.append(helper.make_node("Concat", both, ["logits"], axis=-1))


def pointer_graph(policy: PolicyFile, spec: PointerSpec) -> ModelProto:
    """The pointing network; its output is `logits` [B, N, M + 1], each target, then waiting.

    Raises InputError for one that sees what is still to come: that is no input of the file.
    """
    if spec.unfolds or spec.worths:
        raise InputError("export", "a policy for missions that unfold is not exported; it sees "
                         "what is still to come, or what targets are worth, which is no input of "
                         "the file")
    g = Graph(policy.params)
    agents, targets = _tokens(g)
    x = g.join(g.dense(g.params["agent"], agents), g.dense(g.params["target"], targets), axis=1)
    count = g("Gather", g("Shape", "agents"), g.ints(1))
    spans = {"agent": (g.ints(0), count), "target": (count, g.ints(LAST))}
    pairs = g.gelu(g.dense(g.params["pairs"], _pairs(g)))
    biases = g("Transpose", by_role(g, pairs, spans), perm=[0, 3, 1, 2])
    mask = g.wide(g.join("agents", "targets", axis=1), 1, 2)
    for layer in range(spec.layers):
        part = g.part(biases, 1, g.ints(layer * spec.heads), g.ints((layer + 1) * spec.heads))
        x = block(g, spec, g.params[f"block{layer}"], x, part, mask)
    _point(g, spec, g.norm(g.params["last"], x), pairs, spans)
    given = [helper.make_tensor_value_info(name, kind, ["batch", *dims], words)
             for name, (kind, dims, words) in INPUTS.items()]
    made = [helper.make_tensor_value_info("logits", FLOAT, ["batch", "agents", "choices"],
                                          "each target, then waiting")]
    return model(g, policy, given, made, builder="moonteam/policies/export/onboard_pointer.py "
                 "(NumPy alone) builds the inputs and settles the choices")
