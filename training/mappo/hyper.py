"""The numbers of one phase's updates."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Hyper:
    """Static under jit; `Config.hyper` fills it from a preset."""

    updates: int
    num_minibatches: int
    lr: float
    ent_coef: float
    num_steps: int
    update_epochs: int
    gamma: float
    gae_lambda: float
    clip_eps: float
    vf_coef: float
    max_grad_norm: float
    adam_eps: float
    timeout_is_terminal: bool
