"""Policies as ONNX graphs, written node by node from their parameters: they run without JAX.

The entity network's inputs are the fields of `entity.Entities`, with symbolic dimensions
`batch`, `agents` and `targets`; see `onboard` for what builds them. Names and order of the
computation follow `entity.py` and `recurrent.py`, to which tests hold the results.

Why not by jax2onnx (0.17.1, tried with JAX 0.10.2, flax 0.12.8, onnx 1.23.2): of the entity
network it can make no graph for any number of robots and targets. It loses the dimension of
agents and targets joined in one axis (after the first block the targets' part has length 0),
where `jax.export` keeps it. With 3 robots and 7 targets fixed it does write a file, 20 % larger
(574 kB, 553 nodes; ours 485 kB, 297 nodes), but ONNX Runtime 1.31.1 loads it neither at opset 17
(no BitwiseOr there) nor at 21 (a Reshape of incompatible shapes). The recurrent actor alone comes
out right (485 kB). And it wants orbax-checkpoint < 0.11.37; the runs' checkpoints use 0.12.

Legend: B batch, N agents, M targets, E = N + M tokens, S skill bits, D width, K heads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from onnx import ModelProto, TensorProto, helper

from moonteam.policies.attention import FAR
from moonteam.policies.entity import EntitySpec
from moonteam.policies.export.graph import BOOL, FLOAT, INT, LAST, Graph, block, by_role, model
from moonteam.policies.policy_file import PolicyFile
from moonteam.policies.recurrent import RecurrentSpec
from moonteam.problem.rules import UNREACHABLE
from moonteam.problem.scenario import MAX_SKILLS

ENTITY_INPUTS: dict[str, tuple[int, tuple[str | int, ...], str]] = {
    "agent_cells": (INT, ("agents", 2), "cells (x, y)"),
    "agent_skills": (INT, ("agents",), "bitmask"),
    "agent_mask": (BOOL, ("agents",), "in the team"),
    "target_cells": (INT, ("targets", 2), "cells (x, y)"),
    "target_skills": (INT, ("targets",), "bitmask"),
    "target_and": (BOOL, ("targets",), "all skills are needed together"),
    "target_open": (BOOL, ("targets",), "not solved yet"),
    "travel": (FLOAT, ("agents", "targets"), f"steps; {UNREACHABLE} where there is no way"),
    "between": (FLOAT, ("targets", "targets"), "steps between targets by the best kind"),
    "toward": (BOOL, ("agents", "targets", 4), "moves up, down, left, right that shorten the way"),
    "allowed": (BOOL, ("agents", 4), "moves that are not turned back"),
    "time_left": (FLOAT, (), "steps until the mission must be over"),
    "preference": (FLOAT, (), "0 time .. 1 effort"),
}
"""Type, dimensions after the batch and meaning of each input, in this order."""

_ABOUT = {"actions": "up (+y), down (-y), left (-x), right (+x), stay",
          "builder": "moonteam/policies/export/onboard.py (NumPy alone) builds the inputs"}


def _bits(g: Graph, mask: str) -> str:
    """[...] bitmask -> [..., S] floats."""
    powers = g.constant(2.0 ** np.arange(MAX_SKILLS))
    halves = g("Floor", g("Div", g.wide(g.number(mask), -1), powers))
    return g("Mod", halves, g.constant(2.0), fmod=1)


def _usable(g: Graph, agent: str, need: str) -> str:
    """[B, N, M] bool."""
    share = g("Greater", g("MatMul", agent, g.flipped(need)), g.constant(0.5))
    there = g.both(g.wide("target_open", 1), g.wide("agent_mask", 2))
    return g.both(g.both(share, there), g("Less", "travel", g.constant(UNREACHABLE)))


def _tokens(g: Graph, agent: str, need: str, can: str) -> tuple[str, str]:
    """[B, N, .] and [B, M, .] features of each entity by itself."""
    real, still = g.number("agent_mask"), g.number("target_open")
    count = g.total(g("Mul", agent, g.wide(real, 2)), 1)
    demand = g.total(g("Mul", need, g.wide(still, 2)), 1)
    moment = g.join(g.over(g.wide("time_left", 1), 128.0), g.wide("preference", 1),
                    g.over(g.total(real, 1, keep=True), 4.0),
                    g.over(g.total(still, 1, keep=True), 8.0))
    shared = g.wide(g.join(g.over(count, 4.0), g.over(demand, 8.0), moment), 1)

    def with_moment(rows: str, *parts: str) -> str:
        nothing = g.wide(g("Mul", rows, g.constant(0.0)), 2)  # [B, rows, 1], to broadcast
        return g.join(*parts, g.add(nothing, shared))

    steps, yes = g("Where", can, "travel", g.constant(256.0)), g.number(can)
    kind = g.wide(g.number("target_and"), 2)
    agents = with_moment(real, agent, g.wide(g.over(g.least(steps, 2), 32.0), 2),
                         g.wide(g.over(g.total(yes, 2), 8.0), 2))
    targets = with_moment(still, need, kind, g("Mul", need, kind),
                          g.wide(g.over(g.least(steps, 1), 32.0), 2),
                          g.wide(g.over(g.total(yes, 1), 4.0), 2))
    return agents, targets


def _pairs(g: Graph, agent: str, need: str) -> str:
    """[B, E, E, F] what token j is to token i."""
    here = g.number("agent_cells")
    cells = g.join(here, g.number("target_cells"), axis=1)
    shift = g.over(g("Sub", g.wide(cells, 1), g.wide(cells, 2)), 16.0)
    skills = g.join(agent, need, axis=1)
    shared = g("MatMul", skills, g.flipped(skills))
    covers = g.number(g("GreaterOrEqual", shared, g.wide(g.total(skills, 2), 1)))
    flat = g.total(g("Abs", g("Sub", g.wide(here, 1), g.wide(here, 2))), 3)
    far, known = g.constant(256.0), g.constant(UNREACHABLE)
    across = g("Where", g("Less", "travel", known), "travel", far)
    inner = g("Where", g("Less", "between", known), "between", far)
    travel = g.join(g.join(flat, across), g.join(g.flipped(across), inner), axis=1)
    columns = [g.over(travel, 16.0), g("Log", g.add(travel, g.constant(1.0))),
               g("Exp", g.over(travel, -4.0)),
               g.number(g("Less", travel, g.constant(0.5))), shared, covers]
    return g.join(shift, g("Abs", shift), *(g.wide(c, 3) for c in columns))


def _agree(g: Graph, pointer: str, agent: str, need: str, agents: str) -> str:
    """Pointer logits [B, N, M + 1] after all claims, see `entity.agree`; skills are bits.

    agent [B, N, S], need [B, M, S], agents [1]: N. One turn of the loop is one agent's claim.
    """
    b = Graph(g.params, g)
    none, yes = b.constant(-FAR), b.number("claim_waiting")
    sure = b("ReduceMax", b("LogSoftmax", "claim_logits", axis=-1), axes=[2], keepdims=0)
    turn = b("ArgMax", b("Where", "claim_waiting", sure, b.constant(-2.0 * FAR)), axis=1)
    everyone = b("Range", b.constant(0, np.int64), b("Squeeze", agents), b.constant(1, np.int64))
    mine = b.number(b("Equal", everyone, turn))  # [B, N]
    weight = b.wide(mine, 2)
    row = b.total(b("Mul", weight, "claim_logits"), 1)  # [B, M + 1]
    slots = b("Squeeze", b("Gather", b("Shape", row), b.ints(1)))
    numbers = b("Range", b.constant(0, np.int64), slots, b.constant(1, np.int64))
    picked = b("Equal", numbers, b("ArgMax", row, axis=1))
    picked = b.wide(b.part(picked, 1, b.ints(0), b.ints(-1)), 2)  # [B, M, 1]
    skills = b.wide(b.total(b("Mul", weight, agent), 1), 1)  # [B, 1, S]
    others = b("Mul", b("Sub", b.constant(1.0), skills), b.wide(b.number("target_and"), 2))
    missing = b("Where", picked, b("Mul", "claim_missing", others), "claim_missing")
    waiting = b("Greater", b("Sub", yes, mine), b.constant(0.5))
    useless = b("Less", b("MatMul", agent, b.flipped(missing)), b.constant(0.5))
    shut = b.both(useless, b.wide(waiting, 2))
    logits = b("Where", shut, none, b.part("claim_logits", 2, b.ints(0), b.ints(-1)))
    logits = b.join(logits, b.part("claim_logits", 2, b.ints(-1), b.ints(LAST)))
    going = b("Identity", "claim_going")

    def info(name: str, kind: int, *dims: str | int) -> Any:
        return helper.make_tensor_value_info(name, kind, dims)

    carried = (("logits", logits, FLOAT, ("batch", "agents", "choices")),
               ("missing", missing, FLOAT, ("batch", "targets", MAX_SKILLS)),
               ("waiting", waiting, BOOL, ("batch", "agents")))
    body = helper.make_graph(
        b.nodes, "claim",
        [info("claim_number", TensorProto.INT64), info("claim_going", BOOL),
         *(info(f"claim_{name}", kind, *dims) for name, _, kind, dims in carried)],
        [info(going, BOOL), *(info(made, kind, *dims) for _, made, kind, dims in carried)])
    return g("Loop", g("Squeeze", agents), "", pointer, need, "agent_mask", outputs=3,
             body=body)[0]


def _mix(g: Graph, pointer: str, free: str, share: float) -> None:
    """Action log-probabilities from pointer and free logits, as the output `log_probs`."""
    weight = g("Softmax", pointer, axis=-1)
    aim = g.part(weight, 2, g.ints(0), g.ints(-1))
    moves = g.number("toward")
    moves = g("Div", moves, g("Max", g.total(moves, 3, keep=True), g.constant(1.0)))
    going = g("Squeeze", g("MatMul", g.wide(aim, 2), moves), g.ints(2))
    there = g("Mul", aim, g.number(g("Less", "travel", g.constant(0.5))))
    still = g.add(g.part(weight, 2, g.ints(-1), g.ints(LAST)), g.total(there, 2, keep=True))
    able = g("Pad", g.number("allowed"), g.ints(0, 0, 0, 0, 0, 1), g.constant(1.0))
    able = g("Greater", able, g.constant(0.5))
    loose = g("Softmax", g("Where", able, free, g.constant(-FAR)), axis=-1)
    probs = g.add(g("Mul", g.join(going, still), g.constant(1.0 - share)),
                  g("Mul", loose, g.constant(share)))
    g.nodes.append(helper.make_node(
        "Log", [g("Clip", probs, g.constant(1e-8), g.constant(1.0))], ["log_probs"]))


def entity_graph(policy: PolicyFile, spec: EntitySpec) -> ModelProto:
    """The entity network; outputs `log_probs` [B, N, 5], claims settled, and `pointer`
    [B, N, M + 1] as it was before that.
    """
    g = Graph(policy.params)
    agent, need = _bits(g, "agent_skills"), _bits(g, "target_skills")
    can = _usable(g, agent, need)
    agents, targets = _tokens(g, agent, need, can)
    x = g.join(g.dense(g.params["agent"], agents), g.dense(g.params["target"], targets), axis=1)
    count = g("Gather", g("Shape", "agent_skills"), g.ints(1))
    spans = {"agent": (g.ints(0), count), "target": (count, g.ints(LAST))}
    pairs = g.gelu(g.dense(g.params["pairs"], _pairs(g, agent, need)))
    biases = g("Transpose", by_role(g, pairs, spans), perm=[0, 3, 1, 2])
    mask = g.wide(g.join("agent_mask", "target_open"), 1, 2)
    for layer in range(spec.layers):
        part = g.part(biases, 1, g.ints(layer * spec.heads), g.ints((layer + 1) * spec.heads))
        x = block(g, spec, g.params[f"block{layer}"], x, part, mask)
    x = g.norm(g.params["last"], x)
    robots, goals = (g.part(x, 1, *spans[role]) for role in ("agent", "target"))
    query, key = g.dense(g.params["query"], robots), g.dense(g.params["key"], goals)
    point = g.part(g.part(pairs, 1, *spans["agent"]), 2, *spans["target"])
    bias = g("Squeeze", g.dense(g.params["point_bias"], point), g.ints(3))
    match = g("Mul", g("MatMul", query, g.flipped(key)), g.constant(spec.width**-0.5))
    logits = g("Where", can, g.add(match, bias), g.constant(-FAR))
    pointer = g.join(logits, g.dense(g.params["stay"], robots))
    g.nodes.append(helper.make_node("Identity", [pointer], ["pointer"]))
    acting = _agree(g, pointer, agent, need, count)
    _mix(g, acting, g.dense(g.params["free"], robots), spec.free)
    given = [helper.make_tensor_value_info(name, kind, ["batch", *dims], words)
             for name, (kind, dims, words) in ENTITY_INPUTS.items()]
    made = [helper.make_tensor_value_info("log_probs", FLOAT, ["batch", "agents", 5],
                                          "up, down, left, right, stay"),
            helper.make_tensor_value_info("pointer", FLOAT, ["batch", "agents", "choices"],
                                          "logits: each target, then stay")]
    return model(g, policy, given, made, **_ABOUT)


def recurrent_graph(policy: PolicyFile, spec: RecurrentSpec) -> ModelProto:
    """The recurrent actor: `observation` [N, D] and `memory` [N, H] to `logits`, `memory_out`."""
    g = Graph(policy.params["actor"])
    width, p = spec.width, g.params
    x = g("Relu", g.dense(p["embed"], "observation"))
    if spec.memory:
        gru = p["gru"]
        gates = g.dense(gru["input"], x)
        back = g("MatMul", "memory", g.constant(gru["recurrent"]))
        sizes = g.ints(2 * width, width)
        (gate, candidate), (old, past) = (g("Split", v, sizes, outputs=2, axis=1)
                                          for v in (gates, back))
        both = g("Sigmoid", g.add(gate, old))
        r, z = g("Split", both, g.ints(width, width), outputs=2, axis=1)
        past = g.add(past, g.constant(gru["candidate_bias"]))
        n = g("Tanh", g.add(candidate, g("Mul", r, past)))
        # (1 - z) n + z h
        x = g.add(n, g("Mul", z, g("Sub", "memory", n)))
        g.nodes.append(helper.make_node("Identity", [x], ["memory_out"]))
    else:
        x = g("Relu", g.dense(p["feed_forward"], x))
        g.nodes.append(helper.make_node("Identity", ["memory"], ["memory_out"]))
    x = g("Relu", g.dense(p["mix"], x))
    g.nodes.append(helper.make_node("Identity", [g.dense(p["head"], x)], ["logits"]))
    units = width if spec.memory else 1

    def info(name: str, columns: int, words: str) -> Any:
        return helper.make_tensor_value_info(name, FLOAT, ["agents", columns], words)

    return model(g, policy, [
        info("observation", spec.obs_size, "as `grid.observe` gives it for the training map"),
        info("memory", units, "zeros at the start, then memory_out of the last decision")],
        [info("logits", 5, "up, down, left, right, stay"), info("memory_out", units, "")], **_ABOUT)
