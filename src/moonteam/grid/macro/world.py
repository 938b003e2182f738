"""The rules of the macro world, as pure functions of one episode (vmap them over many).

A decision is a target. An agent that is free chooses one, or to wait; it sets out at once and is
bound until the target is solved. A service starts when all agents bound to the target wait there
and are the coalition that it needs, the targets before it have ended and it has appeared; it ends
`service` seconds later, and its agents are free again. Between events nothing is decided; at
every event that leaves an agent free, all free agents choose, one after the other.

Where targets may still come there may be posts, places to wait at: choosing one is to wait, on the
way there and then there, free all the while to set out for a target.

Choices that lead nowhere are not allowed (see `allowed`), so that no two agents wait for each
other for ever, whatever a policy says. Legend as in `types`.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import Array

from moonteam import trees
from moonteam.grid.macro import sight, streets
from moonteam.grid.macro.types import FAR, MacroProblem, MacroResult, MacroState

NEAR = 0.5
"""s to a post within which an agent is there."""

SOON = 5e-4
"""s below which two events are one; tables are in whole milliseconds."""


def reset(problem: MacroProblem) -> MacroState:
    """The first moment at which somebody can decide."""
    problem = trees.single(problem)
    if problem.sight is not None:
        problem = replace(problem, sight=sight.begun(problem.sight))
    agents, targets = problem.start.shape
    none, zero = jnp.full(agents, targets, jnp.int32), jnp.zeros(agents, jnp.float32)
    start = MacroState(
        problem=problem, now=jnp.zeros((), jnp.float32), node=none, origin=none, leg=zero,
        goal=none, busy=problem.free, serving=jnp.zeros(targets, bool),
        solved=~problem.target_mask, lapsed=jnp.zeros(targets, bool), since=problem.free,
        travelled=zero, served=jnp.zeros(targets, jnp.float32))
    return _run(start, jnp.any(free(start)))[0]


def legs(problem: MacroProblem, node: Array) -> Array:
    """[N, M] s from where each agent is (`node` [N], M: its start) to each target."""
    targets = problem.start.shape[1]
    at = jnp.take_along_axis(problem.between, jnp.minimum(node, targets - 1)[:, None, None],
                             axis=1)[:, 0]
    return jnp.where((node == targets)[:, None], problem.start, at)


def free(state: MacroState) -> Array:
    """[N] bool, agents that choose now."""
    problem = state.problem
    return problem.agent_mask & (state.goal == problem.start.shape[1]) & (state.busy <= 0)


def missing(problem: MacroProblem, goal: Array) -> Array:
    """[M, S] agents of each skill that a target lacks, counting those bound to it by `goal` [N].

    Of an OR target with anybody bound to it: none; before, one of each skill that will do.
    """
    bound = jax.nn.one_hot(goal, problem.start.shape[1], dtype=jnp.int32)  # [N, M]
    there = bound.T @ problem.has.astype(jnp.int32)  # [M, S]
    met = problem.either & jnp.any((there > 0) & (problem.need > 0), axis=1)
    return jnp.where(met[:, None], 0, jnp.maximum(problem.need - there, 0))


def known(state: MacroState) -> Array:
    """[M] bool: somebody knows of it, be it solved or not."""
    problem = state.problem
    count = jnp.sum(state.solved & ~state.lapsed & problem.target_mask & ~problem.looks)
    shown = (state.now >= problem.shown - SOON) & (problem.following <= count)
    return shown if problem.sight is None else shown & (~problem.sight.hidden | problem.sight.found)


def open_targets(state: MacroState) -> Array:
    """[M] bool: known, neither solved nor being served, and of use."""
    moot = state.problem.looks & (coming(state) == 0)
    return ~state.solved & ~state.serving & known(state) & ~moot


def posts(problem: MacroProblem) -> Array:
    """[M] bool: places to wait at, which nobody serves."""
    return problem.looks & ~jnp.any(problem.need > 0, axis=1)


def finished(state: MacroState) -> Array:
    """[] bool: every target is solved."""
    return jnp.all(state.solved | state.problem.looks)


def coming(state: MacroState) -> Array:
    """[] int32, targets that are still to be known of."""
    problem = state.problem
    return problem.coming + jnp.sum(problem.target_mask & ~known(state), dtype=jnp.int32)


def middle_of(state: MacroState, node: Array) -> Array:
    """[N] s to where targets may come, in the mean, from where each agent is (`node` [N])."""
    problem = state.problem
    targets = problem.start.shape[1]
    at = problem.middle[jnp.minimum(node, targets - 1)]
    return jnp.where(node == targets, problem.middle_now, at)


def allowed(state: MacroState, goal: Array) -> Array:
    """[N, M] bool: what each agent may choose, given everybody's `goal` [N] so far.

    An agent may go where it brings a skill that is missing there, if those still missing after
    it can come from agents that do not themselves wait for others; and if all targets that must
    come before are sure to be served. So the coalition begun last can always be completed, then
    the one before it, and so on.
    """
    problem = state.problem
    targets = problem.start.shape[1]
    lacking = missing(problem, goal)  # [M, S]
    complete = jnp.all(lacking == 0, axis=1)
    here = jnp.minimum(goal, targets - 1)
    stuck = (goal < targets) & ~complete[here] & ~state.lapsed[here]
    loose = problem.agent_mask & ~stuck  # [N]
    has = problem.has.astype(jnp.int32)
    able = (problem.start < FAR).astype(jnp.int32)  # [N, M]
    helps = jnp.any((lacking[None] > 0) & problem.has[:, None], axis=2)  # [N, M]
    left = jnp.maximum(lacking[None] - has[:, None], 0)  # [N, M, S]
    left = jnp.where(problem.either[None, :, None], 0, left)
    can = (able * loose[:, None]).T @ has  # [M, S] loose agents with the skill
    others = can[None] - (able * loose[:, None])[:, :, None] * has[:, None]
    whole = jnp.all(others >= left, axis=2)
    sure = state.solved | state.serving | (complete & problem.target_mask)
    before = jnp.all(~problem.after | sure[None], axis=1)  # [M]
    arrives = state.now + legs(problem, state.node)
    in_time = arrives <= jnp.minimum(problem.lapses, FAR / 2)[None] + SOON
    return (open_targets(state) & before)[None] & helps & whole & in_time & free(state)[:, None]


def anyone_coming(state: MacroState) -> Array:
    """[] bool: somebody is on the way, serves, or will be free; so something will happen."""
    bound = jax.nn.one_hot(state.goal, state.solved.shape[0], dtype=bool)
    waits = jnp.any(bound & posts(state.problem)[None], axis=1)
    return jnp.any((state.busy > 0) & state.problem.agent_mask & ~waits)


def with_waiting(may: Array, coming: Array) -> Array:
    """[N, M + 1] bool, what `may` be chosen [N, M] and, last, whether an agent may wait.

    Somebody must go if nobody is on the way (`coming` [] bool): the last who can.
    """
    some = jnp.any(may, axis=1)
    wait = coming | (jnp.sum(some) > 1) | ~some
    return jnp.concatenate([may, wait[:, None]], axis=1)


def choose(state: MacroState, logits: Array, noise: Array) -> tuple[Array, Array]:
    """The free agents' choices, one after the other, the surest first.

    Args:
      state: the moment.
      logits: [N, M + 1], each target, then waiting.
      noise: [N, M + 1] added where the likeliest is taken: zeros for argmax, Gumbel's to sample.

    Returns:
      Choices [N] int32, M for waiting and of agents that are not free; and what each could
      choose from when its turn came, [N, M + 1] bool (waiting alone of those not free).
    """
    agents, targets = state.problem.start.shape
    everyone = jnp.arange(agents)
    post = posts(state.problem)
    stand = (open_targets(state) & post)[None] & (legs(state.problem, state.node) > NEAR)

    def turn(carry: tuple, _: None) -> tuple[tuple, None]:
        goal, choice, mask, todo, coming = carry
        may = allowed(state, goal) & todo[:, None]  # [N, M]
        options = with_waiting(may, coming)
        options = options.at[:, :targets].set(may | (stand & todo[:, None] & options[:, targets:]))
        held = jnp.where(options, logits, -FAR)
        sure = jnp.max(jax.nn.log_softmax(held, axis=1), axis=1)
        # Who has no choice comes last, not to count as the surest.
        order = jnp.where(jnp.any(may, axis=1), sure, -2 * FAR)
        first = jnp.argmax(jnp.where(todo, order, -3 * FAR))
        pick = jnp.argmax(jnp.where(options[first], logits[first] + noise[first], -FAR))
        pick = pick.astype(jnp.int32)
        own = (everyone == first) & todo
        choice = jnp.where(own, pick, choice)
        mask = jnp.where(own[:, None], options, mask)
        goal = jnp.where(own, pick, goal)
        goes = (pick < targets) & ~post[jnp.minimum(pick, targets - 1)]
        return (goal, choice, mask, todo & ~own, coming | (jnp.any(own) & goes)), None

    alone = jnp.zeros((agents, targets + 1), bool).at[:, targets].set(True)
    none = jnp.full(agents, targets, jnp.int32)
    start = (state.goal, none, alone, free(state), anyone_coming(state))
    (_, choice, mask, _, _), _ = jax.lax.scan(turn, start, None, agents)
    return choice, mask


def step(state: MacroState, choice: Array) -> MacroResult:
    """Everybody free sets out for its `choice` [N] (M: waits); then to the next decision.

    Choices of agents that are not free are not looked at.
    """
    problem = state.problem
    targets = problem.start.shape[1]
    going = free(state) & (choice < targets)
    index = jnp.minimum(choice, targets - 1)
    leg = jnp.take_along_axis(legs(problem, state.node), index[:, None], axis=1)[:, 0]
    if problem.sight is not None:
        aim = sight.aimed(problem.sight, choice)
        leg = jnp.linalg.norm(aim - problem.sight.here, axis=1) / problem.sight.speed
        aim = jnp.where(going[:, None], aim, problem.sight.aim)
        problem = replace(problem, sight=replace(problem.sight, aim=aim))
    leg = jnp.where(going, leg, 0.0)
    out = replace(
        state, problem=problem, goal=jnp.where(going, choice, state.goal),
        node=jnp.where(going, choice, state.node),
        origin=jnp.where(going, state.node, state.origin), leg=jnp.where(going, leg, state.leg),
        busy=jnp.where(going, leg, state.busy), travelled=state.travelled + leg)
    after, dead = _run(out, jnp.array(False))
    done = finished(after)
    # Who served nothing more was on the way home since it was last free.
    way = jnp.where(problem.agent_mask, _way_home(problem, after.node), 0.0)
    end = jnp.maximum(jnp.max(jnp.where(problem.agent_mask, after.since + way, 0.0)), after.now)
    end = jnp.where(done, end, after.now)
    effort = jnp.sum(problem.effort * (leg + jnp.where(done, way, 0.0)))
    missed = jnp.sum(jnp.where(after.lapsed & ~state.lapsed, problem.worth, 0.0))
    return MacroResult(after, end - state.now, effort, missed, done, ~done & dead)


def loosen(state: MacroState, who: Array) -> MacroState:
    """The state in which those of `who` [N] bool that are on their way may choose again.

    How far it is from everywhere (`along`) stands in `problem.start` and `problem.home_now`, for
    from now on the agent starts there.
    """
    problem = state.problem
    targets = problem.start.shape[1]
    here = jnp.minimum(state.goal, targets - 1)
    who = who & problem.agent_mask & (state.goal < targets) & (state.busy > 0)
    # Nobody turns away from a target that others, bound already, wait for.
    bound = jnp.any(jax.nn.one_hot(state.goal, targets, dtype=bool), axis=0)
    due = jnp.any(problem.after & bound[:, None], axis=0)
    who = who & ~state.serving[here] & ~due[here]
    rest = jnp.minimum(state.busy, state.leg)
    gone = state.leg - rest
    if problem.streets is None:
        start = along(legs(problem, state.origin), legs(problem, state.node), gone[:, None],
                      rest[:, None])
        middle = (rest * middle_of(state, state.origin) + gone * middle_of(state, state.node)
                  ) / jnp.maximum(gone + rest, SOON)
    else:
        turned = streets.turned(problem.streets, who, state.origin, state.node, gone)
        start = jnp.where(problem.start < FAR, streets.ways(turned), FAR)
        middle = streets.middle_now(turned)
        problem = replace(problem, streets=turned)
    own = jax.nn.one_hot(state.goal, targets, dtype=bool)
    start = jnp.where(own, rest[:, None], start)
    near, far = _way_home(problem, state.origin), _way_home(problem, state.node)
    # Of those that need not go home both are 0, where nobody has anywhere to go.
    home = jnp.where((near <= 0) & (far <= 0), 0.0, along(near, far, gone, rest))
    out = replace(problem, start=jnp.where(who[:, None], start, problem.start),
                  home_now=jnp.where(who, home, problem.home_now),
                  middle_now=jnp.where(who, middle, problem.middle_now))
    travelled = state.travelled - jnp.where(who, rest, 0.0)
    return _placed(replace(
        state, problem=out, travelled=travelled, node=jnp.where(who, targets, state.node),
        goal=jnp.where(who, targets, state.goal), busy=jnp.where(who, 0.0, state.busy),
        since=jnp.where(who, state.now, state.since)))


def _placed(state: MacroState) -> MacroState:
    """The state with the ways as they are now, where targets are hidden: whoever is free starts
    where it is, and places to look from move with what is left to see.
    """
    problem, targets = state.problem, state.solved.shape[0]
    if problem.sight is None:
        return state
    start, between = sight.ways(problem.sight)
    middle, middle_now = sight.middles(problem.sight)
    return replace(
        state, problem=replace(problem, start=start, between=between, middle=middle,
                               middle_now=middle_now, unseen=problem.sight.unseen),
        node=jnp.where(state.goal == targets, targets, state.node))


def along(near: Array, far: Array, gone: Array, rest: Array) -> Array:
    """s to c from the point of the way from a to b that is `gone` s from a and `rest` s from b.

    Stewart's theorem, of `near` s from a to c and `far` s from b to c: exact on straight ways. On
    others it is kept within what the triangle allows, and may be off by as much (see `streets`).
    """
    square = (rest * near**2 + gone * far**2) / jnp.maximum(gone + rest, SOON) - gone * rest
    low = jnp.maximum(jnp.abs(near - gone), jnp.abs(far - rest))
    high = jnp.minimum(near + gone, far + rest)
    there = jnp.clip(jnp.sqrt(jnp.maximum(square, 0.0)), jnp.minimum(low, high), high)
    return jnp.where((near >= FAR) | (far >= FAR), jnp.where(high >= FAR, FAR, high), there)


def _way_home(problem: MacroProblem, node: Array) -> Array:
    """[N] s home from where each agent is (`node` [N], M: its start)."""
    targets = problem.start.shape[1]
    at = jnp.take_along_axis(problem.home, jnp.minimum(node, targets - 1)[:, None], axis=1)[:, 0]
    return jnp.where(node == targets, problem.home_now, at)


def _run(state: MacroState, moved: Array) -> tuple[MacroState, Array]:
    """To the next moment at which somebody is free, or the end; and whether it can only fail.

    Event by event: time goes on to the next arrival, end of a service or appearance, then services
    that can start do, so that nobody decides while others stand where they are about to serve.
    `moved` [] bool: the present moment is such a one.
    """
    def begun(state: MacroState) -> tuple[MacroState, Array]:
        started = _start(state)
        return started, jnp.any(started.solved & ~state.solved)

    def waits(carry: tuple) -> Array:
        state, dead, moved, again = carry
        decide = moved & ~again & jnp.any(free(state)) & jnp.any(open_targets(state))
        return ~(finished(state) | dead | decide)

    def event(carry: tuple) -> tuple:
        state, _, moved, again = carry
        later, dead, quiet = _advance(state)
        # A service without length sets its agents free at once, and what comes after it can start.
        state = jax.tree.map(lambda a, b: jnp.where(again, a, b), state, later)
        started, again_now = begun(state)
        return started, dead & ~again, moved | again | ~quiet, again_now

    first, again = begun(state)
    start = first, jnp.array(False), moved | again, again
    state, dead, _, _ = jax.lax.while_loop(waits, event, start)
    return _placed(state), dead


def _start(state: MacroState) -> MacroState:
    """Starts every service whose coalition waits, all that are bound to it."""
    problem = state.problem
    targets = problem.start.shape[1]
    waiting = (state.goal < targets) & (state.busy <= 0)
    there = jnp.where(waiting, state.goal, targets)
    coming = jax.nn.one_hot(jnp.where(waiting, targets, state.goal), targets, dtype=bool)
    met = jnp.all(missing(problem, there) == 0, axis=1) & ~jnp.any(coming, axis=0)
    met = met & ~posts(problem)
    before = jnp.all(~problem.after | state.solved[None], axis=1)
    window = (state.now >= problem.appears - SOON) & (state.now <= problem.lapses + SOON)
    # Who has come to look does so, of use or not.
    starts = ~state.solved & ~state.serving & known(state) & met & before & window
    at_once = starts & (problem.service <= 0)
    here = jnp.minimum(state.goal, targets - 1)
    serves = waiting & starts[here]
    ends = serves & at_once[here]
    return replace(
        state, serving=state.serving | (starts & ~at_once), solved=state.solved | at_once,
        busy=jnp.where(serves, problem.service[here], state.busy),
        goal=jnp.where(ends, targets, state.goal), since=jnp.where(ends, state.now, state.since),
        served=jnp.where(starts, state.now, state.served))


def _advance(state: MacroState) -> tuple[MacroState, Array, Array]:
    """To the next event; whether there is none, or none before the limit; and whether it is only
    that somebody came to a post.
    """
    problem = state.problem
    targets = problem.start.shape[1]
    arrivals = jnp.where((state.busy > 0) & problem.agent_mask, state.busy, FAR)
    here = jnp.minimum(state.goal, targets - 1)
    stands = (state.goal < targets) & posts(problem)[here]
    waiting = (state.goal < targets) & (state.busy <= 0)
    opens = problem.appears[here] - state.now
    opens = jnp.where(waiting & (opens > 0), opens, FAR)
    news = problem.shown - state.now
    news = jnp.where((news > SOON) & ~state.solved, news, FAR)
    losses = jnp.where(problem.agent_mask & (problem.lost < FAR / 2),
                       jnp.maximum(problem.lost - state.now, 0.0), FAR)
    optional, pending = problem.worth > 0, ~state.solved & ~state.serving
    ends = problem.lapses - state.now + 2 * SOON
    ends = jnp.where(optional & pending & (problem.lapses < FAR / 2), jnp.maximum(ends, 0.0), FAR)
    rest = jnp.min(jnp.where(stands, FAR, arrivals))
    moving = (arrivals < FAR) & (state.goal < targets) & ~state.serving[here]
    finds = FAR if problem.sight is None else sight.first_find(
        problem.sight, state.busy, moving, FAR)
    wait = jnp.minimum(jnp.minimum(jnp.minimum(rest, finds), jnp.min(opens)),
                       jnp.minimum(jnp.min(news), jnp.minimum(jnp.min(losses), jnp.min(ends))))
    there = jnp.min(jnp.where(stands, arrivals, FAR))
    quiet = there < wait - SOON
    wait = jnp.minimum(wait, there)
    late = pending & ~optional & (state.now > problem.lapses + SOON)
    dead = (wait >= FAR / 2) | jnp.any(late)
    left = jnp.maximum(problem.limit - state.now, 0.0)
    over = wait > left + SOON
    wait = jnp.where(dead, 0.0, jnp.where(over, left, wait))
    dead = dead | over
    busy = state.busy - wait
    busy = jnp.where(busy <= SOON, 0.0, busy)
    now = state.now + wait
    bound = state.goal < targets
    finished = bound & state.serving[here] & (busy <= 0)
    ended = jnp.any(jax.nn.one_hot(jnp.where(finished, state.goal, targets), targets,
                                   dtype=bool), axis=0)
    released = (state.busy > 0) & (busy <= 0) & ~bound  # of those that could not yet set out
    lapses = optional & pending & (now > problem.lapses + SOON)
    lapsed = state.lapsed | lapses
    found, looked = jnp.array(False), jnp.zeros(targets, bool)
    if problem.sight is not None:
        seen = sight.gone_on(problem.sight, state.busy, moving, wait)
        found, looked = jnp.any(seen.found & ~problem.sight.found), seen.looked
        problem = replace(problem, sight=seen)
    vain = bound & (busy <= 0) & (lapsed[here] | stands | looked[here])  # waits for nothing there
    after = replace(
        state, problem=problem, now=now, busy=busy, serving=state.serving & ~ended,
        solved=state.solved | ended | lapses | looked, lapsed=lapsed,
        goal=jnp.where(finished | vain, targets, state.goal),
        since=jnp.where(finished | released | vain, now, state.since))
    # Whatever is found may concern everybody.
    return _without_lost(loosen(after, (bound & lapsed[here]) | found)), dead, quiet


def _without_lost(state: MacroState) -> MacroState:
    """Agents whose time has come leave the team, and their services are broken off."""
    problem = state.problem
    targets = problem.start.shape[1]
    gone = problem.agent_mask & (problem.lost <= state.now + SOON)
    serves = jax.nn.one_hot(state.goal, targets, dtype=bool) & state.serving[None]  # [N, M]
    broken = jnp.any(serves & gone[:, None], axis=0)  # [M]
    stays = jnp.any(serves & broken[None], axis=1)  # who waits there again
    return replace(
        state, problem=replace(problem, agent_mask=problem.agent_mask & ~gone),
        serving=state.serving & ~broken, goal=jnp.where(gone, targets, state.goal),
        busy=jnp.where(gone | stays, 0.0, state.busy))
