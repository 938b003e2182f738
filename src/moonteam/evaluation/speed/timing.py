"""How long planners think, against the number of targets, on this machine.

Two questions are kept apart: how long a whole plan takes, and how long one decision takes. A
search must plan the whole mission to decide at all, so its decision is its plan; a policy
decides without planning. First calls (compiling, loading) are apart everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import numpy as np

from moonteam.errors import InputError
from moonteam.grid.scenarios import generate
from moonteam.planners import registry
from moonteam.planners.base import OBJECTIVES, Snapshot, check_objective
from moonteam.planners.best_of import plan_best_of
from moonteam.planners.decode import parse
from moonteam.planners.kind import DEFAULT_POLICY, PlannerOptions
from moonteam.planners.learned import LearnedPlanner
from moonteam.planners.pointing import PointingPlanner
from moonteam.policies import policy_file, recurrent
from moonteam.policies.brain import PointerBrain, RecurrentBrain
from moonteam.policies.policy import Policy
from moonteam.policies.recurrent import RecurrentSpec
from moonteam.report import clock, provenance
from moonteam.report.progress import track
from moonteam.report.tables import duration

POLICY = "policy"
USUAL = ("exact", "greedy", "exhaustive", POLICY)
EXACT = "exact(makespan)"
DECISION, PLAN, BEST = "policy, one decision", "policy, whole plan", "policy, best of"


@dataclass(frozen=True)
class Sizes:
    """What is measured, and how much of it."""

    targets: Sequence[int]
    count: int = 50
    num_agents: int = 3
    side: int = 32
    max_steps: int = 128
    budget: float = 10.0  # seconds a planner and size may take
    best_of: int = 16
    seed: int = 0
    planners: Sequence[str] = USUAL
    objectives: Sequence[str] = ()  # empty: all of the exact planner, else makespan
    time_limit: float | None = None  # seconds a plan, of anytime planners

    def check(self) -> None:
        """Raises InputError if a number makes no sense."""
        if not self.targets or min(self.targets) < 1:
            raise InputError("--targets", "numbers of at least 1 are needed")
        for name in ("count", "best_of"):
            if getattr(self, name) < 1:
                raise InputError(f"--{name.replace('_', '-')}", "at least 1")
        for objective in self.objectives:
            check_objective(objective, 1.0, 0.05)
        PlannerOptions(time_limit=self.time_limit)
        for name in self.planners:
            registry.find(name)
        if self.budget <= 0:
            raise InputError("--budget", f"{self.budget} is not allowed; above 0")

    def scenarios(self, targets: int) -> list[Snapshot]:
        """The instances of one size."""
        return [Snapshot.start(generate(
            np.random.default_rng([self.seed, targets, i]), num_agents=self.num_agents,
            num_targets=targets, size=(self.side, self.side), max_steps=self.max_steps))
            for i in range(self.count)]


def untrained(spec: RecurrentSpec) -> Policy:
    """The paper's network with random weights: as fast as a trained one."""
    params = jax.jit(partial(recurrent.init, spec))(jax.random.key(0))
    stored = policy_file.PolicyFile("recurrent", {}, {})
    return Policy(RecurrentBrain(spec), params, stored, "untrained network")


def policy_for(given: Policy | None, sizes: Sizes, targets: int) -> Policy:
    """The given policy if it takes any size, else its network made for this size."""
    if given is not None and not isinstance(given.brain, RecurrentBrain):
        return given
    wanted = RecurrentSpec(sizes.num_agents, targets, (sizes.side, sizes.side))
    if given is not None and isinstance(given.brain, RecurrentBrain):
        made = given.brain.spec
        wanted = replace(wanted, width=made.width, memory=made.memory)
        if made == replace(wanted, num_skills=made.num_skills, normalise=made.normalise):
            return given
    return untrained(wanted)


def methods(policy: Policy | None, sizes: Sizes, targets: int
            ) -> dict[str, Callable[[Snapshot], Any]]:
    """What is timed at one size, by the names of the report; `policy` None if none is wanted."""
    found: dict[str, Callable[[Snapshot], Any]] = {}
    for name in dict.fromkeys(sizes.planners):
        kind = registry.find(name)
        if kind.most_targets is not None and targets > kind.most_targets:
            continue
        if kind.name == POLICY and policy is not None:
            found |= _policy_methods(policy, sizes.best_of)
            continue
        usual = OBJECTIVES if kind.name == "exact" else ("makespan",)
        for objective in sizes.objectives or usual:
            found[f"{kind.name}({objective})"] = registry.make(name, PlannerOptions(
                check_objective(objective, 1.0, 0.05), time_limit=sizes.time_limit, seed=sizes.seed,
                policy=policy or DEFAULT_POLICY)).plan
    return found


def _policy_methods(policy: Policy, best_of: int) -> dict[str, Callable[[Snapshot], Any]]:
    planner = LearnedPlanner(policy)

    def decide(moment: Snapshot) -> Any:
        planner.reset(moment)
        return planner.act(moment)

    def best(count: int) -> Callable[[Snapshot], Any]:
        if not isinstance(policy.brain, PointerBrain):
            return lambda moment: plan_best_of(policy, moment, count)
        decode = f"best-of-{count}" if count > 1 else "argmax"
        return PointingPlanner(policy, parse(decode), PlannerOptions()).plan

    return {DECISION: decide, PLAN: best(1), f"{BEST} {best_of} plans": best(best_of)}


def evaluate(given: Policy | None, sizes: Sizes, command: str, cores: str = "") -> dict:
    """The measurements as a JSON-able document; `cores` says in words what ran on how many."""
    sizes.check()
    rows, learned = [], POLICY in sizes.planners
    wanted = any(registry.find(name).wants_policy for name in sizes.planners)
    for targets in track(list(sizes.targets), "timing", len(sizes.targets)):
        moments = sizes.scenarios(targets)
        policy = policy_for(given, sizes, targets) if wanted else None
        if policy is not None:
            policy.check(moments[0])
        for name, call in methods(policy, sizes, targets).items():
            times = clock.measure(call, moments, sizes.budget)
            rows.append({"planner": name, "targets": targets, **times.document()})
    kind = "untrained network of the paper" if given is None else given.source.kind
    notes = [*findings(rows),
             f"{sizes.num_agents} agents on {sizes.side} x {sizes.side}, up to {sizes.count} "
             f"random scenarios a size; medians of single calls, first calls apart"
             f"{'; ' + cores if cores else ''}. A search's decision is its plan."
             + (" The policy's plan is one jitted call that ends when no rollout can become "
                f"better, or with {sizes.max_steps} decisions; its network: {kind}."
                if learned else "")]
    return {"title": "planning time against the number of targets", "rows": rows,
            "notes": notes, "meta": provenance.meta(command, sizes.seed)}


def findings(rows: Sequence[dict]) -> list[str]:
    """In words, from the measurements alone: where the exact planner is faster."""
    exact_times = _by_targets(rows, EXACT)
    said = []
    for name, what in ((DECISION, "the policy makes one decision"),
                       (PLAN, "the policy rolls out a whole plan")):
        other = _by_targets(rows, name)
        both = sorted(exact_times.keys() & other.keys())
        faster = [t for t in both if exact_times[t] < other[t]]
        slower = [t for t in both if exact_times[t] >= other[t]]
        if faster:
            said.append(f"The exact planner (makespan) returns a certified optimal plan of the "
                        f"whole mission sooner than {what} at {_list(faster)} targets "
                        f"(at {faster[-1]}: {_versus(exact_times, other, faster[-1])}).")
        if slower:
            said.append(f"The exact planner (makespan) takes longer than {what} at "
                        f"{_list(slower)} targets (at {slower[0]}: "
                        f"{_versus(exact_times, other, slower[0])}).")
    slow = _by_targets(rows, "exhaustive(makespan)")
    shared = sorted(slow.keys() & exact_times.keys())
    if shared:
        most = shared[-1]
        said.append(f"Exhaustive search takes {slow[most] / exact_times[most]:.3g} times as long "
                    f"as the exact planner at {most} targets "
                    f"({_versus(exact_times, slow, most)}).")
    return said + _policy_times(rows)


def _policy_times(rows: Sequence[dict]) -> list[str]:
    """What the policy takes, at 7 targets or the size next to it."""
    best = [row for row in rows if row["planner"].startswith(BEST)]
    if not best:
        return []
    row = min(best, key=lambda row: abs(row["targets"] - 7))
    one = _by_targets(rows, DECISION)[row["targets"]]
    return [f"At {row['targets']} targets the policy makes one decision in {duration(one)} and "
            f"the {row['planner'].removeprefix('policy, ')} in {duration(row['seconds'])}."]


def _by_targets(rows: Sequence[dict], name: str) -> dict[int, float]:
    return {row["targets"]: row["seconds"] for row in rows if row["planner"] == name}


def _list(numbers: Sequence[int]) -> str:
    *most, last = map(str, numbers)
    return f"{', '.join(most)} and {last}" if most else last


def _versus(ours: dict[int, float], theirs: dict[int, float], targets: int) -> str:
    return f"{duration(ours[targets])} against {duration(theirs[targets])}"


def pivot(document: dict) -> tuple[list[str], list[list[str]]]:
    """Titles and rows of a table: a planner a row, a number of targets a column."""
    rows = document["rows"]
    sizes = sorted({row["targets"] for row in rows})
    names = list(dict.fromkeys(row["planner"] for row in rows))
    at = {(row["planner"], row["targets"]): row for row in rows}
    first = {name: max(row["first_call_seconds"] for row in rows if row["planner"] == name)
             for name in names}
    table = [[name, *(duration(at[name, size]["seconds"]) if (name, size) in at else "-"
                      for size in sizes), duration(first[name])] for name in names]
    return ["median seconds a call", *(f"{size} targets" for size in sizes),
            "longest first call"], table
