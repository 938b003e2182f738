"""`moonteam evaluate unfolding`: rows side by side in the same futures."""

import json

import numpy as np
import pytest

from moonteam import loading, paths
from moonteam.cli import main
from moonteam.commands import testsets_unfolding
from moonteam.errors import InputError
from moonteam.evaluation import timed, unfolding
from moonteam.evaluation.contenders import Options
from moonteam.planners.unfolding import draw
from moonteam.problem.timed import Agent, Target, Timed
from moonteam.report.intervals import Bootstrap


def report(capsys, *words):
    assert main(["evaluate", "unfolding", *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_rows_meet_the_same_futures_and_are_compared_with_the_first(capsys, tmp_path):
    words = ["unfolding/following", "--limit", "12", "--planner", "exact", "--planner", "greedy",
             "--out", str(tmp_path / "run")]
    document = report(capsys, *words)
    exact, greedy = document["summary"]
    assert [exact["planner"], greedy["planner"]] == ["exact(makespan)", "greedy(makespan)"]
    assert exact["gap"] == 0.0
    by_row = {name: [row for row in document["rows"] if row["planner"] == name]
              for name in ("exact(makespan)", "greedy(makespan)")}
    a, b = (np.array([row["seconds"] for row in by_row[name]]) for name in by_row)
    assert greedy["gap"] == pytest.approx((b - a).mean() / a.mean())
    low, high = greedy["intervals"]["gap"]
    assert low < greedy["gap"] < high
    bound = np.array([row["optimal"]["bound"] for row in by_row["exact(makespan)"]])
    assert exact["bound_gap"] == pytest.approx(a.sum() / bound.sum() - 1)
    for name in ("report.json", "rows.csv", "table.md", "unfolding.png"):
        assert (tmp_path / "run" / name).stat().st_size > 0


def test_an_interrupted_run_goes_on_to_the_same_report(capsys, tmp_path):
    words = ["unfolding/arrivals", "--limit", "6", "--planner", "exact", "--futures", "3"]
    whole = report(capsys, *words)
    report(capsys, *words, "--out", str(tmp_path))
    lines = (tmp_path / "rows.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "rows.jsonl").write_text("".join(lines[:7]) + lines[7][:20])
    resumed = report(capsys, *words, "--out", str(tmp_path), "--resume")
    assert resumed["rows"] == whole["rows"]


def test_a_policy_plays_a_set_side_by_side_as_it_plays_one_mission():
    problems = loading.load_set(paths.find("unfolding/arrivals", "testsets", ".jsonl"))[:4]
    (contender,) = timed.contenders(Options(
        ["policy"], policies=[paths.find("any_team_mappo", "policies", ".safetensors")]))
    (row,) = unfolding.rows_of([contender], [], [])
    assert row.together
    side_by_side = row.play_all(problems, 0)
    assert all(played.success for played in side_by_side)
    (alone,) = row.play_all(problems[1:2], 0)
    assert (side_by_side[1].seconds, side_by_side[1].decisions) == (alone.seconds, alone.decisions)


def test_rows_over_futures_are_those_asked_for():
    contenders = timed.contenders(Options(
        ["exact", "policy"], policies=[paths.find("unfolding", "policies", ".safetensors")]))

    def names(*words, **more):
        return [row.name for row in unfolding.rows_of(contenders, *words, **more)]

    exact, policy = "exact(makespan)", "policy(argmax)"
    assert names([8], [], ["waiting"], ahead=True, foresee=["policies"]) == [
        exact, policy, f"{policy} over 8 futures, waiting"]
    assert names([8], [], (), ahead=True, foresee=["planners"]) == [
        exact, f"{exact} over 8 futures", policy]
    assert names([2, 8], [], (), ahead=True, foresee=["planners", "policies"]) == [
        exact, f"{exact} over 2 futures", policy, f"{policy} over 8 futures"]
    # Over none it is a policy that plans once all is known.
    assert names([0, 8], [], ["makespan", "waiting"], ahead=True) == [
        exact, f"{exact} over 8 futures", f"{exact} over 8 futures, waiting", policy,
        f"{policy}, then planned", f"{policy} over 8 futures", f"{policy} over 8 futures, waiting"]
    for hidden in (["places"], ["nearest"]):
        with pytest.raises(InputError, match="--futures: 0 is for policies"):
            names([0], hidden, (), ahead=True)
    # Over futures by places alone, where these are asked for; plans agree on what ends soonest.
    assert names([8], ["sweep", "places"], (), ahead=True) == [
        f"{exact}, sweep", f"{exact}, places", f"{exact} over 8 futures, places",
        f"{policy}, sweep", f"{policy}, places", f"{policy} over 8 futures, places"]
    assert names([8], ["places"], ["waiting"], ahead=True) == [
        f"{exact}, places", f"{policy}, places"]
    assert f"{policy} over 8 futures, sweep" in names([8], ["sweep"], (), ahead=True)


def test_failures_count_with_the_limit_and_their_cause_is_said(capsys):
    document = report(capsys, "unfolding/losses", "--limit", "60")
    failed = [row for row in document["rows"] if not row["success"]]
    assert failed
    assert all(row["seconds"] == 300.0 and row["lost"] == 1 for row in failed)
    assert document["summary"][0]["success"] == 1 - len(failed) / 60
    never = sum(map(unfolding.hopeless, loading.load_set(
        paths.find("unfolding/losses", "testsets", ".jsonl"))[:60]))
    assert 0 < never <= len(failed)
    assert any(note.startswith(f"{never} missions nobody") for note in document["notes"])
    assert any(f"{len(failed)} x the robots that are left cannot serve target" in note
               for note in document["notes"])


def test_missions_that_nobody_can_solve_are_told_apart():
    """A robot that alone can drill, 20 m from where it must: lost before it is there, or after."""
    def mission(lost):
        agents = (Agent((0.0, 0.0), ("drill",), lost=lost), Agent((1.0, 0.0), ("eye",)))
        return Timed("seconds", agents, (Target((20.0, 0.0), ("drill", "eye")),
                                         Target((0.0, 5.0), ("eye",))))

    assert unfolding.hopeless(mission(19.9))
    assert not unfolding.hopeless(mission(20.1))
    assert not unfolding.hopeless(mission(None))


def test_the_bundled_sets_are_drawn_again_by_their_seed():
    for name in draw.FAMILIES:
        held = loading.load_set(paths.find(f"unfolding/{name}", "testsets", ".jsonl"))
        assert len(held) == 1000
        again = testsets_unfolding.make(testsets_unfolding.Recipe(name), 3, 0, (1.5, 0.36, 0.47),
                                        lambda *_: None)
        assert again == held[:3]


def test_a_third_of_the_missions_lose_one_robot():
    held = loading.load_set(paths.find("unfolding/losses", "testsets", ".jsonl"))
    lost = [sum(agent.lost is not None for agent in one.agents) for one in held]
    assert max(lost) == 1
    assert np.mean(lost) == pytest.approx(1 / 3, abs=0.05)


@pytest.mark.parametrize(("words", "says"), [
    (["3x5"], "3x5: is in steps"), (["--futures", "1"], "--futures: 1 is not allowed; 2 to 4096"),
    (["--futures", "0"], "--futures: 0 is for policies by argmax that can look ahead"),
    (["--goal", "waiting"], "--goal: has no effect without --futures"),
    (["--foresee", "policies"], "--foresee: has no effect without --futures"),
    (["--futures", "4", "--foresee", "all", "--foresee", "policies"],
     "--foresee: given 2 times; once, or as often as --futures"),
    (["--search", "sweep"], "--search sweep: has no effect where no target is hidden; stay"),
    (["--planner", "best"], "no such planner by the clock"),
    (["--decode", "sample"], "--decode: has no effect without --planner policy"),
    (["unfolding/follow"], "unfolding/follow"), (["--resume"], "--resume: needs the folder")])
def test_wrong_words_are_one_line(capsys, words, says):
    assert main(["evaluate", "unfolding", *words]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert says in err
    assert len(err.strip().splitlines()) == 1


def test_an_interval_of_differences_is_that_of_the_missions_own():
    """Paired: what all missions have in common does not widen it."""
    base = np.linspace(10.0, 200.0, 50)
    found = Bootstrap(50, 0).ratio((base + 1.0) - base, base)
    assert found.value == pytest.approx(1.0 / base.mean())
    assert found.high - found.low < 0.01


def test_what_has_been_seen_grows_and_is_drawn(tmp_path):
    assert main(["evaluate", "unfolding", "unfolding/hidden", "--limit", "3", "--search", "sweep",
                 "--out", str(tmp_path / "out")]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    [row] = report["summary"]
    share = row["seen"]["share"]
    assert share == sorted(share)
    assert 0.0 < share[0] < 0.5 < share[-1] <= 1.0
    assert row["seen"]["seconds"][-1] <= max(one["seconds"] for one in report["rows"])
    assert (tmp_path / "out" / "unfolding.png").stat().st_size > 10_000
