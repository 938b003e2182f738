"""A policy file, ready to act."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import msgspec

from moonteam import paths
from moonteam.errors import InputError, not_one_of
from moonteam.policies import entity, pointer, policy_file, recurrent
from moonteam.policies.brain import Brain, EntityBrain, Mission, PointerBrain, RecurrentBrain
from moonteam.policies.entity import EntitySpec
from moonteam.policies.pointer import PointerSpec
from moonteam.policies.recurrent import RecurrentSpec


@dataclass(frozen=True)
class Policy:
    """Parameters with the brain that they belong to."""

    brain: Brain
    params: Any
    source: policy_file.PolicyFile
    path: str

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Policy:
        """Reads a policy file, or the bundled policy of that name.

        Raises InputError if it is none, or its parts do not fit.
        """
        path = paths.find(os.fspath(path), "policies", ".safetensors")
        stored = policy_file.load_policy(path)
        kinds: dict[str, Any] = {"recurrent": (RecurrentSpec, RecurrentBrain, recurrent.init),
                                 "entity": (EntitySpec, EntityBrain, entity.init),
                                 "pointer": (PointerSpec, PointerBrain, pointer.init)}
        if stored.kind not in kinds:
            raise InputError(path, "network kind " + not_one_of(stored.kind, kinds))
        spec_type, brain_type, init = kinds[stored.kind]
        try:
            spec = msgspec.convert(stored.config, spec_type)
        except msgspec.ValidationError as error:
            raise InputError(path, f"its header describes no {stored.kind} network: "
                             f"{error}") from None
        spec.check(path)
        policy_file.check_shapes(path, stored.params, _shapes(init, spec))
        params = jax.tree.map(jnp.asarray, stored.params)
        return cls(brain_type(spec), params, stored, str(path))

    def check(self, mission: Mission) -> None:
        """Raises InputError if the policy was made for another kind of mission."""
        problem = self.brain.misfit(mission)
        if problem:
            raise InputError(self.path, problem)


@lru_cache(64)
def _shapes(init: Any, spec: Any) -> Any:
    """Of a network's parameters."""
    return jax.eval_shape(partial(init, spec), jax.random.key(0))
