"""What a MAPPO run on macro-decisions is made of, and the presets."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from moonteam.errors import InputError
from moonteam.grid.macro.draw import Draw
from moonteam.policies.pointer import PointerSpec
from training.mappo.macro.hyper import Hyper, Tries, Vine


@dataclass(frozen=True)
class Practice:
    """Problems of one family, and how much of them."""

    name: str
    """For tables and curves."""
    draw: Draw
    """What is drawn."""
    grounds: int = 0
    """P, maps with blocked cells made beforehand and drawn from; 0: open maps."""
    shrink: int = 1
    """Environments, or moments branched, are this many times fewer: large problems cost more."""
    advantages: Literal["vine", "critic", "tries"] = "vine"
    """From branches played out, from the critic, or from whole tries of the same problem."""


@dataclass(frozen=True)
class MacroConfig:
    """A whole run; every round makes one update on each family."""

    macro: str
    """The preset these numbers started from."""
    families: tuple[Practice, ...]
    """What is practised, each round on all of them."""
    rounds: int
    """Rounds of collecting and improving."""
    num_envs: int = 512
    """E, environments of each family."""
    hyper: Hyper = field(default_factory=Hyper)
    """Of an update."""
    vine: Vine = field(default_factory=Vine)
    """Of an update by branches."""
    tries: Tries = field(default_factory=Tries)
    """Of an update by whole tries."""
    spec: PointerSpec = field(default_factory=PointerSpec)
    """Size of the network."""
    lr: float = 2e-3
    """Learning rate at the start; falls linearly to a twentieth."""
    ent_coef: float = 0.01
    """Entropy bonus at the start; falls linearly to 0 at five sixths of the run."""
    precision: Literal["float32", "tf32", "bfloat16"] = "float32"
    """Of matrix products; parameters and losses are float32 in all three."""
    seed: int = 0
    """Seed of everything random in training."""
    chunk_rounds: int = 5
    """Rounds between two looks from outside (logging, checkpoint, signals)."""
    eval_every: int = 4
    """Chunks between evaluations on held-out scenarios."""
    eval_scenarios: int = 256
    """Held-out scenarios of each family; fewer of one that shrinks."""

    def __post_init__(self) -> None:
        self.spec.check(self.macro)
        for key in ("rounds", "num_envs", "chunk_rounds", "eval_every", "eval_scenarios"):
            if getattr(self, key) < 1:
                raise InputError(self.macro, f"{getattr(self, key)} is not allowed; at least 1",
                                 key)
        for name, keys in (("hyper", ("num_steps", "epochs", "minibatches", "part")),
                           ("vine", ("episodes", "moments", "epochs", "minibatches", "longest")),
                           ("tries", ("problems", "epochs", "rows"))):
            for key in keys:
                if (value := getattr(getattr(self, name), key)) < 1:
                    raise InputError(self.macro, f"{value} is not allowed; at least 1",
                                     f"{name}.{key}")
        for key, value in (("vine.options", self.vine.options), ("tries.each", self.tries.each)):
            if value < 2:
                raise InputError(self.macro, f"{value} is not allowed; at least 2", key)
        for key, value in (("vine.tau", self.vine.tau), ("tries.heat", self.tries.heat)):
            if value <= 0.0:
                raise InputError(self.macro, f"{value:g} is not allowed; above 0", key)
        if not 0.0 < self.lr <= 0.1:
            raise InputError(self.macro, f"{self.lr:g} is not allowed; above 0, at most 0.1", "lr")
        for key, value in (("hyper.learned", self.hyper.learned),
                           ("tries.learned", self.tries.learned)):
            if not 0.0 < value <= 1.0:
                raise InputError(self.macro, f"{value:g} is not allowed; above 0, at most 1", key)
        for one in self.families:
            self._check(one)

    def _check(self, family: Practice) -> None:
        """Whether there is enough of a family, and whether it can be parted."""
        if family.advantages == "vine":
            vine = self.grown(family)
            if vine.moments < 1 or vine.moments % vine.minibatches or (
                    vine.moments > vine.episodes * vine.num_steps):
                raise InputError(self.macro, f"{vine.moments} moments of {family.name} are not "
                                 f"divided by {vine.minibatches} minibatches, are more than its "
                                 f"{vine.episodes} x {vine.num_steps} decisions, or none",
                                 "vine.moments")
        elif family.advantages == "tries":
            tries = self.tried(family)
            if tries.moments < 1:
                raise InputError(self.macro, f"{tries.problems} problems of {family.name} leave "
                                 "no moments to learn from", "tries.problems")
        else:
            rows = self.rows(family)
            if self.envs(family) < 1 or rows < 1 or rows % self.hyper.minibatches:
                raise InputError(
                    self.macro, f"{self.hyper.minibatches} minibatches do not divide the {rows} "
                    f"moments learned from of {self.envs(family)} environments x "
                    f"{self.hyper.num_steps} decisions of {family.name}", "hyper.minibatches")

    def grown(self, family: Practice) -> Vine:
        """Of a family: fewer moments of large problems, in fewer minibatches of the same size."""
        vine = self.vine
        steps = vine.num_steps or family.draw.turns
        # As many decisions as the paper's team would take, in episodes of this length.
        episodes = vine.episodes // family.shrink * (vine.num_steps or 14) // steps
        return replace(vine, num_steps=steps, episodes=max(8, episodes // 8 * 8),
                       moments=vine.moments // family.shrink,
                       minibatches=max(1, vine.minibatches // family.shrink))

    def tried(self, family: Practice) -> Tries:
        """Of a family: fewer large problems."""
        return replace(self.tries, num_steps=self.tries.num_steps or family.draw.turns,
                       problems=self.tries.problems // family.shrink)

    def envs(self, family: Practice) -> int:
        """Environments of a family."""
        return self.num_envs // family.shrink

    def rows(self, family: Practice) -> int:
        """Moments of a family that a pass learns from."""
        return int(self.envs(family) * self.hyper.num_steps * self.hyper.learned)

    def moments(self, family: Practice) -> int:
        """Of a family in a round: those learned from, with the critic all that are decided."""
        if family.advantages == "critic":
            return self.envs(family) * self.hyper.num_steps
        return (self.grown if family.advantages == "vine" else self.tried)(family).moments

    @property
    def decisions(self) -> int:
        """Moments in a round, of all families."""
        return sum(self.moments(family) for family in self.families)


PAPER = Practice("3 robots, 5 to 7 targets", Draw())
CREW = Draw(agents=(6, 12), targets=(9, 20), num_skills=1, metric="straight", numbers=5,
            service=1.9, homes=1.0, crews=(1, 1), limit=8000.0)
"""Robots that start together and are needed several at once, as in others' instances."""
HYPER = Hyper(loose=0.2)

ANY_TEAM = MacroConfig(
    "any_team", (
        PAPER,
        Practice("3 unlike robots, 1 to 8 targets",
                 Draw(targets=(1, 8), metric="either", unlike=0.8, service=1.0, numbers=2,
                      homes=0.2, sides=(16, 48), limit=4000.0), shrink=2),
        Practice("2 to 5 robots, 3 to 10 targets, 3 skills",
                 Draw(agents=(2, 5), targets=(3, 10), num_skills=3, sides=(8, 64),
                      metric="either", unlike=0.3, limit=4000.0), shrink=2),
        Practice("3 robots, 4 to 7 targets, blocked",
                 Draw(agents=(3, 3), targets=(4, 7), num_skills=2, unlike=0.3,
                      limit=4000.0), grounds=2048, shrink=2),
        Practice("4 to 8 robots, 3 to 10 targets, 3 skills",
                 Draw(agents=(4, 8), targets=(3, 10), num_skills=3, sides=(16, 48),
                      metric="either", unlike=0.3, limit=4000.0), shrink=4),
        Practice("2 to 6 robots, 8 to 14 targets",
                 Draw(agents=(2, 6), targets=(8, 14), sides=(16, 48), metric="either",
                      unlike=0.3, limit=4000.0), shrink=4),
        # Of many robots and targets whole tries say more than branches, and are cheap enough.
        Practice("5 to 8 robots, 12 to 24 targets",
                 Draw(agents=(5, 8), targets=(12, 24), num_skills=3, metric="either",
                      unlike=0.3, limit=8000.0), shrink=16, advantages="tries"),
        Practice("6 to 8 robots, 24 to 40 targets",
                 Draw(agents=(6, 8), targets=(24, 40), metric="either", unlike=0.2,
                      limit=8000.0), shrink=32, advantages="tries"),
    ),
    # Of many targets returns are long, and their squared error could drown the choices.
    rounds=300, hyper=replace(HYPER, spread=True, vf_coef=0.05, ema=0.9995), lr=1e-3,
    spec=PointerSpec(layers=5), chunk_rounds=2, eval_every=5)

PRESETS = {
    "quick": MacroConfig("quick", (PAPER,), rounds=90, hyper=HYPER),
    "paper_team": MacroConfig("paper_team", (PAPER,), rounds=600, hyper=HYPER),
    "any_team": ANY_TEAM,
    "any_team_further": replace(
        ANY_TEAM, macro="any_team_further", rounds=100, lr=3e-4,
        # Two robots for many targets are a long way behind the exact planner, and rarely drawn.
        families=(*ANY_TEAM.families,
                  Practice("2 robots, 4 to 10 targets", Draw(agents=(2, 2), targets=(4, 10))))),
    "crews": MacroConfig(
        "crews", (
            Practice("6 to 12 robots of one kind, 9 to 20 targets for up to 5", CREW,
                     shrink=4, advantages="tries"),
            Practice("10 to 20 robots of one kind, 20 to 50 targets for up to 5",
                     replace(CREW, agents=(10, 20), targets=(20, 50)), shrink=32,
                     advantages="tries"),
            Practice("9 to 15 robots of 3 to 5 kinds, 10 to 20 targets",
                     replace(CREW, agents=(9, 15), targets=(10, 20), crews=(3, 5), num_skills=5,
                             numbers=1), shrink=8, advantages="tries"),
        ),
        rounds=60, hyper=replace(HYPER, vf_coef=0.05), spec=PointerSpec(layers=5), lr=3e-4,
        chunk_rounds=2, eval_every=5, eval_scenarios=128),
    "unfolding": MacroConfig(
        "unfolding", (
            Practice("5 + 5, the next when one is solved", Draw(targets=(10, 10), following=5)),
            Practice("3 + 5, the next by a clock",
                     Draw(targets=(8, 8), metric="straight", speeds=(1.5, 0.36, 0.47),
                          arriving=5, every=10.0, limit=300.0)),
        ),
        # What comes makes returns noisy: a branch may move the policy less.
        rounds=300, hyper=HYPER, vine=Vine(tau=0.5), spec=PointerSpec(unfolds=True), lr=5e-4),
    "lapsing": MacroConfig(
        "lapsing", (
            Practice("2 + 10 by a clock, each lapses",
                     Draw(targets=(12, 12), metric="straight", speeds=(1.5, 0.36, 0.47),
                          arriving=10, every=8.0, limit=300.0, worth=(1.0, 5.0), posts=True)),
        ),
        rounds=200, hyper=replace(HYPER, vf_coef=0.05), vine=Vine(tau=0.15),
        spec=PointerSpec(unfolds=True, worths=True, posts=True), lr=5e-4),
    "searching": MacroConfig(
        "searching", (
            Practice("5 hidden targets", Draw(
                targets=(5, 5), metric="straight", speeds=(1.5, 0.36, 0.47), looks=4,
                limit=600.0), shrink=2),
        ),
        # What is found is luck, more of it than of what comes elsewhere.
        rounds=360, hyper=HYPER, vine=Vine(tau=2.0), spec=PointerSpec(layers=5, unfolds=True),
        lr=3e-4, eval_scenarios=2048),
}
"""By the word behind `moonteam train`."""
