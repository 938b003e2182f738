"""Skills as a person reads them."""

import pytest

from moonteam.problem.skills import held, needed


@pytest.mark.parametrize(("skills", "of_a_robot", "every", "any_of_them"), [
    (("A",), "A", "A", "A"),
    (("A", "B"), "AB", "A+B", "A/B"),
    (("camera",), "camera", "camera", "camera"),
    (("camera", "radio"), "camera, radio", "camera + radio", "camera / radio"),
    (("A", "radio"), "A, radio", "A + radio", "A / radio")])
def test_letters_stand_close_together_and_names_apart(skills, of_a_robot, every, any_of_them):
    assert held(skills) == of_a_robot
    assert (needed(skills, either=False), needed(skills, either=True)) == (every, any_of_them)
