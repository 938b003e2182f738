"""Grid state in, joint action out: what every planner offers, exact, greedy or learned.

Legend: N agents, M targets, K kinds. NumPy on the host; cells are (x, y).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import msgspec
import numpy as np
import numpy.typing as npt

from moonteam.errors import InputError, not_one_of
from moonteam.problem import rules
from moonteam.problem.scenario import ACTIONS, Scenario

IntArray = npt.NDArray[np.int32]
BoolArray = npt.NDArray[np.bool_]
Objective = Literal["makespan", "moves", "weighted"]
SAMPLING = 0.5
"""Temperature at which policies draw actions, the best of those tried for best-of-K."""
OBJECTIVES: tuple[Objective, ...] = ("makespan", "moves", "weighted")


def check_objective(objective: str, alpha: float, beta: float) -> Objective:
    """The objective, if it is one and its weights make sense. Raises InputError."""
    known: dict[str, Objective] = {name: name for name in OBJECTIVES}
    if objective not in known:
        raise InputError("--objective", not_one_of(objective, OBJECTIVES))
    if objective == "weighted" and not (
            alpha >= 0 and beta >= 0 and 0 < alpha + beta < math.inf):
        raise InputError("--objective weighted", f"alpha {alpha} and beta {beta} are not allowed; "
                         "both at least 0, one above 0")
    return known[objective]


@dataclass(frozen=True)
class Snapshot:
    """A moment of a mission on the grid, as a planner sees it; may be mid-episode.

    A lost robot stays in the arrays with `agent_mask` False. Skill masks follow
    `Scenario.skill_bits`.
    """

    size: tuple[int, int]  # (W, H) cells
    cells: IntArray  # [N, 2] cells
    agent_skills: IntArray  # [N] bitmask
    agent_kinds: IntArray  # [N] index into passable
    agent_mask: BoolArray  # [N] True: still in the team
    target_cells: IntArray  # [M, 2] cells
    target_skills: IntArray  # [M] bitmask
    target_and: BoolArray  # [M]
    solved: BoolArray  # [M]
    step: int = 0
    max_steps: int = 128
    passable: BoolArray | None = None  # [K, H, W] indexed [kind, y, x]
    skill_names: tuple[str, ...] = tuple("ABCDEFGH")  # of bits 1, 2, 4, ...

    @classmethod
    def start(cls, scenario: Scenario) -> Snapshot:
        """The scenario before the first decision, nothing solved but what holds at reset."""
        agents, targets = scenario.agents, scenario.targets
        kinds, passable = passable_maps(scenario)
        cells = np.array([a.at for a in agents], np.int32)
        skills = np.array([scenario.mask(a.skills) for a in agents], np.int32)
        target_cells = np.array([t.at for t in targets], np.int32).reshape(-1, 2)
        need = np.array([scenario.mask(t.skills) for t in targets], np.int32)
        both = np.array([t.type == "AND" and len(set(t.skills)) > 1 for t in targets], bool)
        return cls(
            size=scenario.size, cells=cells, agent_skills=skills, agent_kinds=kinds,
            agent_mask=np.ones(len(agents), bool), target_cells=target_cells,
            target_skills=need, target_and=both,
            solved=solved_now(cells, skills, target_cells, need, both),
            step=0, max_steps=scenario.max_steps, passable=passable,
            skill_names=skill_names(scenario))


def skill_names(scenario: Scenario) -> tuple[str, ...]:
    """Name of every skill bit 1, 2, 4, ...; bits that are not used have their letter."""
    names = list("ABCDEFGH")
    for name, bit in scenario.skill_bits.items():
        names[bit.bit_length() - 1] = name
    return tuple(names)


def passable_maps(scenario: Scenario) -> tuple[IntArray, BoolArray | None]:
    """Each agent's kind index [N] and the passable maps [K, H, W]; None on an open map."""
    kinds = sorted({a.kind or "*" for a in scenario.agents})
    index = np.array([kinds.index(a.kind or "*") for a in scenario.agents], np.int32)
    if not scenario.blocked:
        return index, None
    width, height = scenario.size
    passable = np.ones((len(kinds), height, width), bool)
    for k, kind in enumerate(kinds):
        for x, y in (*scenario.blocked.get("*", ()), *scenario.blocked.get(kind, ())):
            passable[k, y, x] = False
    return index, passable


def solved_now(cells: IntArray, skills: IntArray, target_cells: IntArray, need: IntArray,
               both: BoolArray) -> BoolArray:
    """[M] True where the agents now standing in a target's cell meet its requirement."""
    here = (cells[:, None] == target_cells[None]).all(-1)  # [N, M]
    present = np.bitwise_or.reduce(np.where(here, skills[:, None], 0), axis=0)
    return rules.met(present, need, both)


class Visit(msgspec.Struct, frozen=True):
    """One event of a schedule: these agents solve this target at this step."""

    target: int
    agents: tuple[int, ...]
    step: int


@dataclass(frozen=True)
class Plan:
    """A joint plan from a snapshot until every target is solved.

    `status`: optimal (certified), feasible (best found, `bound` is a lower bound of the
    objective) or infeasible (no actions; `reason` says which target and skills).
    """

    planner: str
    objective: Objective
    status: Literal["optimal", "feasible", "infeasible"]
    makespan: int | None  # steps from the snapshot until all are solved
    moves: int | None  # total team effort from the snapshot
    bound: float | None
    seconds: float
    actions: IntArray  # [T, N] 0..4
    schedule: tuple[Visit, ...] = ()
    reason: str = ""

    def document(self) -> dict:
        """The JSON document that `moonteam plan --json` prints."""
        keys = ("planner", "objective", "status", "makespan", "moves", "bound", "seconds")
        out: dict = {key: getattr(self, key) for key in keys}
        out["actions"] = [[ACTIONS[a] for a in row] for row in self.actions.tolist()]
        out["schedule"] = [msgspec.to_builtins(visit) for visit in self.schedule]
        return out | ({"reason": self.reason} if self.reason else {})


@runtime_checkable
class Planner(Protocol):
    """Decides the team's next joint action; may keep memory between decisions of a mission."""

    name: str

    def reset(self, snapshot: Snapshot, seed: int = 0) -> None:
        """Starts a mission; forgets the last one. Raises InputError if it cannot serve it."""
        ...

    def act(self, snapshot: Snapshot) -> IntArray:
        """Joint action [N] 0..4 for the current moment; called once a decision."""
        ...


@runtime_checkable
class WholePlanner(Planner, Protocol):
    """A planner that also plans a mission to its end; what the registry makes is one."""

    def plan(self, snapshot: Snapshot) -> Plan:
        """A whole plan from this moment. Raises InputError if it cannot serve it."""
        ...
