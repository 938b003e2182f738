"""Sets played by a pointing policy: the environment's word on plans made in batches."""

import numpy as np
import pytest

from moonteam.evaluation import world as worlds
from moonteam.evaluation.contenders import Options, contenders
from moonteam.evaluation.played import play
from moonteam.grid.scenarios import generate
from moonteam.planners.base import Snapshot
from moonteam.planners.decode import parse
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.pointing import PointingPlanner
from moonteam.policies.policy import Policy


@pytest.fixture(scope="module")
def policy(pointing):
    return Policy.load(pointing)


def family(count=4, targets=4):
    return [generate(i, num_agents=3, num_targets=targets, size=(9, 9), max_steps=90)
            for i in range(count)]


def test_a_set_is_played_as_its_plans_promise(policy):
    small = worlds.build(family())
    options = PlannerOptions()
    played = play(policy, small, parse("argmax"), options, "t")
    alone = play(policy, small, parse("argmax"), options, "t", alone=True)
    assert played.success.all()
    plans = [PointingPlanner(policy, parse("argmax"), options).plan(Snapshot.start(s))
             for s in small.scenarios]
    assert played.steps.tolist() == alone.steps.tolist() == [p.makespan for p in plans]
    assert played.moves.tolist() == [p.moves for p in plans]


def test_more_tries_are_no_worse(policy):
    small = worlds.build(family())
    means = {}
    for k in (1, 8):
        for objective in ("makespan", "moves"):
            found = play(policy, small, parse(f"best-of-{k}@2"),
                         PlannerOptions(objective, seed=1), "t")
            means[k, objective] = found.steps.mean(), found.moves.mean()
    assert means[8, "makespan"][0] < means[1, "makespan"][0]
    assert means[8, "moves"][1] < means[1, "moves"][1]


def test_targets_that_appear_are_planned_for(policy):
    later = worlds.build(family(targets=6), num_buffer=2)
    played = play(policy, later, parse("argmax"), PlannerOptions(), "t")
    assert played.success.all()
    assert (played.rescues == 0).all()


def test_rows_name_the_preference_and_speak_of_no_watch(policy, pointing):
    rows = contenders(Options(["policy"], policies=[pointing], preferences=[0.0, 1.0]))
    assert [row.name for row in rows] == [
        "policy(argmax, preference 0)", "policy(argmax, preference 1)"]
    small = worlds.build(family())
    rows[0].check(small)
    outcome = rows[0].run(small)
    assert np.asarray(outcome.success).all()
    assert "watch" not in outcome.note
