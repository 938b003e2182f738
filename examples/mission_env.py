"""A mission in physics, decision by decision: by chance, by a planner, or by a bundled policy.

python examples/mission_env.py sampling                                 # random allowed choices
python examples/mission_env.py sampling exact
python examples/mission_env.py sampling policy any_team
"""

import sys

import jax
import jax.numpy as jnp

import moonteam


def by_chance(env, key, state):
    """Of each robot one of the choices that it has."""
    actions = {}
    for i, (agent, may) in enumerate(env.get_avail_actions(state).items()):
        logits = jnp.where(may, 0.0, -jnp.inf)
        actions[agent] = jax.random.categorical(jax.random.fold_in(key, i), logits)
    return actions


def play(env, planner=None, seed=0, **options):
    """An episode to its end: the last state, seconds and whether it succeeded."""
    keeper = env.keeper(planner, **options) if planner else None
    key = jax.random.key(seed)
    _, state = env.reset(key)
    seconds, done, infos = 0.0, False, {}
    while not done:
        key, own = jax.random.split(key)
        actions = (env.actions(keeper.act(env.moment(state))) if keeper
                   else by_chance(env, own, state))
        _, state, _, dones, infos = env.step_env(own, state, actions)
        seconds, done = seconds + float(infos["seconds"][0]), bool(dones["__all__"])
        print(f"{seconds:6.1f} s, decision {int(state.count)}, {state.seen.choice.tolist()}")
    return state, seconds, bool(infos["success"][0])


if __name__ == "__main__":
    name, *who = sys.argv[1:] or ["sampling"]
    env = moonteam.make("MoonMission-v0", mission=name)
    state, seconds, success = play(env, *who[:1], **({"policy": who[1]} if who[1:] else {}))
    print(f"{name}: {'success' if success else 'failed'} after {seconds:.1f} s")
    print([(target.name, target.time_s) for target in env.report(state).targets])
