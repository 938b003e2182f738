"""Tables for a terminal: whole where they fit, else turned; never wider than there is room."""

from moonteam.report.tables import _width, fitted

TITLES = ["contender", "success", "seconds", "decisions"]
ROWS = [["closed exact barrier", "20 of 20, 1.000 [0.839, 1.000]", "41.5 [39.0, 44.1]", "18.0"],
        ["closed greedy barrier", "19 of 20, 0.950 [0.764, 0.991]", "47.2 [44.0, 50.5]", "21.0"]]


def test_what_fits_stays_as_it_is():
    assert fitted(TITLES, ROWS, 90) == [(TITLES, ROWS)]
    assert fitted(TITLES, [], 5) == [(TITLES, [])]


def test_what_does_not_fit_is_turned_and_cut():
    turned = fitted(TITLES, ROWS, 80)
    assert turned == [(["contender", *[row[0] for row in ROWS]],
                       [[title, *[row[k] for row in ROWS]] for k, title in enumerate(TITLES)][1:])]
    one, two = fitted(TITLES, ROWS, 60)
    assert one[0] == ["contender", "closed exact barrier"]
    assert two[0] == ["contender", "closed greedy barrier"]
    assert all(_width([head, *lines]) <= 60 for head, lines in (one, two))


def test_width_counts_the_longest_line_of_a_cell():
    assert _width([["ab", "c"], ["a\nbcde", ""]]) == 4 + 3 + 1 + 3 + 1
