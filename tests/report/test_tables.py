"""Tables for a terminal: whole where they fit, else turned; never wider than there is room."""

import csv

from rich.console import Console

from moonteam.report.tables import _width, fitted, parts, plain_csv, show_rows

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


def shown(capsys, width, rows):
    show_rows(Console(width=width), ["step", "[who]"], rows, "the plan", right=("step",))
    return [line.strip(" │┃") for line in capsys.readouterr().out.splitlines()
            if not set(line.strip()) & set("━─┏┡└├╇┴┼")]


def test_parts_stand_one_a_line_where_they_do_not_fit_side_by_side(capsys):
    rows = [["1", parts(["R1", "R2", "R3"], "with")], ["12", "R1"]]
    assert rows[0][1] == ["R1", "with R2", "with R3"]
    assert shown(capsys, 40, rows)[1:] == [
        "step ┃ [who]", "1 │ R1 with R2 with R3", "12 │ R1"]
    assert [line.split() for line in shown(capsys, 20, rows)[1:]] == [
        ["step", "┃", "[who]"], ["1", "│", "R1"], ["with", "R2"], ["with", "R3"], ["12", "│", "R1"]]


def test_rows_of_a_csv_may_know_unlike_things():
    text = plain_csv([{"won": True, "a_m": 1.5}, {"won": False, "b_m": 2.5, "why": None}])
    assert list(csv.reader(text.splitlines())) == [
        ["won", "a_m", "b_m", "why"], ["1", "1.5", "", ""], ["0", "", "2.5", ""]]
