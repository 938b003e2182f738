"""The judge of plans by the clock."""

from dataclasses import replace

import numpy as np

from moonteam.planners.seconds.base import Service, effort, makespan, moment, problems
from moonteam.problem import timed

TWO = timed.check(timed.Timed(
    clock="seconds", agents=(timed.Agent((0, 0), ("A",), home=(0, 0)),),
    targets=(timed.Target((3, 0), ("A",)), timed.Target((3, 0), ("A",), service=2))), "two")


def test_a_target_on_the_way_of_another_that_starts_with_it():
    now = moment(TWO)
    now = replace(now, home=np.array([[9000, 3000]]))
    both = (Service(1, (0,), 3000, 5000), Service(0, (0,), 3000, 3000))
    assert problems(now, both) == []
    assert makespan(now, both) == 8000
    assert effort(now, both) == 6000


def test_the_judge_finds_what_is_wrong():
    now = moment(TWO)
    soon = (Service(0, (0,), 2000, 2000), Service(1, (0,), 3000, 5000))
    assert any("is there at 3000" in line for line in problems(now, soon))
    assert any("serves [0]" in line for line in problems(now, soon[:1]))
    short = (Service(0, (0,), 3000, 3000), Service(1, (0,), 3000, 4000))
    assert any("is not its service" in line for line in problems(now, short))
