"""An exported policy held against the original on states that the original visits."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from moonteam.evaluation import rollouts
from moonteam.evaluation import world as worlds
from moonteam.evaluation.rollouts import Player, Pool
from moonteam.grid.config import EnvConfig
from moonteam.grid.macro import draw
from moonteam.grid.macro import world as macro
from moonteam.grid.macro.draw import Draw
from moonteam.grid.macro.types import MacroState
from moonteam.grid.observe import observe
from moonteam.grid.scenarios import generate
from moonteam.policies import entity, pointer
from moonteam.policies.brain import EntityBrain, PointerBrain, RecurrentBrain
from moonteam.policies.entity import EntitySpec
from moonteam.policies.pointer import Outlook, PointerSpec
from moonteam.policies.policy import Policy
from moonteam.problem.scenario import Scenario
from moonteam.report.progress import track

SIZES: tuple[dict[str, Any], ...] = (
    {"num_agents": 2, "num_targets": 4, "size": (16, 16)},
    {"num_agents": 3, "num_targets": 7},
    {"num_agents": 6, "num_targets": 12, "num_skills": 3},
    {"num_agents": 3, "num_targets": 6, "size": (24, 24), "kinds": ["a", "b", "c"],
     "blocked": {"a": 0.0, "b": 0.15, "c": 0.25}},
)
"""What a policy for any team is tried on; the last with blocked ground."""

VISITS = 10  # states of one scenario, some steps apart

FAMILIES: tuple[Draw, ...] = (
    Draw(),
    Draw(agents=(1, 4), targets=(2, 10), num_skills=3, metric="either", speeds=(0.5, 1.0),
         unlike=0.5, service=1.0, homes=0.5),
    Draw(agents=(4, 8), targets=(8, 16), num_skills=3, metric="straight", numbers=3, service=0.5),
)
"""What a pointing policy is tried on."""

PROBLEMS = 16  # of a family, played at once


class Comparison(NamedTuple):
    """Over the states compared."""

    states: int
    largest: float  # difference of log-probabilities (logits of a recurrent or pointing network)
    agree: float  # share of the robots' likeliest actions, or settled choices, that are the same

    def document(self) -> dict:
        """For JSON."""
        return self._asdict()


def scenarios(policy: Policy, count: int, seed: int) -> list[list[Scenario]]:
    """Random scenarios of sizes that the policy takes, enough for `count` states."""
    sizes = SIZES
    if isinstance(policy.brain, RecurrentBrain):
        spec = policy.brain.spec
        sizes = ({"num_agents": spec.num_agents, "num_targets": spec.num_targets,
                  "num_skills": spec.num_skills, "size": tuple(spec.size)},)
    each = -(-count // (VISITS * len(sizes)))
    return [[generate(np.random.default_rng([seed, i, j]), **size) for j in range(each)]
            for i, size in enumerate(sizes)]


def visited(policy: Policy, found: list[Scenario], preference: Array) -> Iterator[Pool]:
    """The scenarios [E] under way, as argmax plays them."""
    world = worlds.build(found)
    player = Player(world.config, policy.brain, sample=False, watch=False, longest=world.longest)
    numbers = jnp.arange(len(found), dtype=jnp.int32)
    pool = rollouts.begin(player, rollouts.source_of(world, policy.brain), numbers, numbers * 0)
    for visit in range(VISITS):
        yield pool
        if visit + 1 < VISITS:
            pool = rollouts.play(player, policy.params, pool, np.uint32(0), np.float32(1.0),
                                 preference)


@partial(jax.jit, static_argnums=0)
def _entity(spec: EntitySpec, params: Any, pool: Pool, preference: Array) -> tuple[Any, Array]:
    """What the network sees of each state [E], and its log-probabilities [E, N, 5]."""
    def look(state: Any, horizon: Any, wish: Array, fields: Array | None) -> Any:
        return entity.look(state, horizon, wish, fields)

    view = jax.vmap(look)(pool.walk.state, pool.given.horizon, preference, pool.given.fields)
    return view, entity.decide(params, spec, view).log_probs


def _answers(policy: Policy, session: Any, pool: Pool,
             preference: Array) -> tuple[np.ndarray, np.ndarray]:
    """[E, N, 5] of the original and of the exported file, which is asked one state at a time."""
    if isinstance(policy.brain, EntityBrain):
        view, known = _entity(policy.brain.spec, policy.params, pool, preference)
        fields = {f: np.asarray(getattr(view, f)) for f in view.__dataclass_fields__}
        said = [session.run(["log_probs"], {k: v[i:i + 1] for k, v in fields.items()})[0]
                for i in range(len(preference))]
        return np.asarray(known), np.concatenate(said)
    brain = policy.brain
    assert isinstance(brain, RecurrentBrain)
    config = EnvConfig(normalize_positions=brain.spec.normalise)
    obs = np.asarray(jax.vmap(partial(observe, config))(pool.walk.state), np.float32)
    _, known = brain.logits(policy.params, pool.memory, pool.walk.state, None, pool.given.horizon,
                            preference)
    said = [session.run(["logits"], {"observation": obs[i], "memory": np.asarray(memory)})[0]
            for i, memory in enumerate(pool.memory)]
    return np.asarray(known), np.stack(said)


class _Decision(NamedTuple):
    """A moment of the macro world [E], as the original sees and settles it."""

    view: Outlook
    logits: Array  # [E, N, M + 1]
    choice: Array  # [E, N] int32
    free: Array  # [E, N] bool


@partial(jax.jit, static_argnums=0)
def _decide(spec: PointerSpec, params: Any, state: MacroState, preference: Array) -> _Decision:
    view = jax.vmap(pointer.look)(state, preference)
    logits = pointer.point(params, spec, view).logits
    return _Decision(view, logits, _settle(state, logits), jax.vmap(macro.free)(state))


@jax.jit
def _settle(state: MacroState, logits: Array) -> Array:
    """[E, N] the likeliest choices, one after the other."""
    return jax.vmap(macro.choose)(state, logits, jnp.zeros_like(logits))[0]


@jax.jit
def _on(state: MacroState, choice: Array) -> tuple[MacroState, Array]:
    """The next moment, at which those on their way may turn; and whether it was the last [E]."""
    result = jax.vmap(macro.step)(state, choice)
    loose = jax.vmap(macro.loosen)(result.state, jnp.ones(choice.shape, bool))
    return loose, result.terminated | result.truncated


def moments(policy: Policy, family: Draw, count: int,
            seed: int) -> Iterator[tuple[MacroState, _Decision, np.ndarray]]:
    """At least `count` moments that a pointing policy visits, in batches [E] of problems played.

    The last is [E] bool, whether the problem is still under way: moments that count.
    """
    assert isinstance(policy.brain, PointerBrain)
    spec, made = policy.brain.spec, jax.jit(jax.vmap(partial(draw.draw, family)))
    preference, turn = jnp.linspace(0.0, 1.0, PROBLEMS), 0
    start = jax.jit(jax.vmap(macro.reset))
    while count > 0:
        keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), turn), PROBLEMS)
        state, going, turn = start(made(keys)), np.ones(PROBLEMS, bool), turn + 1
        while going.any() and count > 0:
            found = _decide(spec, policy.params, state, preference)
            yield state, found, going
            count -= int(going.sum())
            state, over = _on(state, found.choice)
            going = going & ~np.asarray(over)


def _pointed(policy: Policy, session: Any, count: int, seed: int) -> Comparison:
    """Logits of every agent and target, padded and closed ones too; choices of who is free."""
    states, largest, same, choices = 0, 0.0, 0, 0
    each = -(-count // len(FAMILIES))
    for family in track(FAMILIES, "comparing", len(FAMILIES)):
        for state, known, going in moments(policy, family, each, seed):
            view = {one.name: np.asarray(getattr(known.view, one.name))
                    for one in session.get_inputs()}
            said = session.run(["logits"], view)[0]
            free = np.asarray(known.free) & going[:, None]
            alike = np.asarray(_settle(state, jnp.asarray(said)) == known.choice)
            apart = np.abs(np.asarray(known.logits) - said)[going]
            states, largest = states + int(going.sum()), max(largest, float(apart.max()))
            same, choices = same + int((alike & free).sum()), choices + int(free.sum())
    return Comparison(states, largest, same / choices)


def compare(policy: Policy, model: bytes, count: int, seed: int = 0) -> Comparison:
    """Asks both on at least `count` states; needs onnxruntime."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    if isinstance(policy.brain, PointerBrain):
        return _pointed(policy, session, count, seed)
    states, largest, same = 0, 0.0, []
    groups = scenarios(policy, count, seed)
    for found in track(groups, "comparing", len(groups)):
        preference = jnp.linspace(0.0, 1.0, len(found))
        for pool in visited(policy, found, preference):
            known, said = _answers(policy, session, pool, preference)
            states += len(found)
            largest = max(largest, float(np.abs(known - said).max()))
            same.append((known.argmax(-1) == said.argmax(-1)).mean())
    return Comparison(states, largest, float(np.mean(same)))
