"""HTML pages: whole, escaped, self-contained; the evaluation's page says what its report says."""

import colorsys
import re
from html.parser import HTMLParser

import msgspec
import numpy as np
import pytest

from moonteam.planners.plans import figure
from moonteam.report import markup, video
from sim2grid.frame import Frame
from sim2grid.measure.metrics import GridPlan, make_report
from sim2grid.measure.story import Story
from sim2grid.show import page, plots
from sim2grid.show.picture import ROBOTS, Ground
from sim2grid.study.evaluation_page import best_means, evaluation_page
from sim2grid.study.fleet import GIVEN
from sim2grid.study.mission_cards import optimum
from tests.browser import needs_chromium, visit

VOID = {"meta", "img", "br"}


class Reader(HTMLParser):
    """Reads a page; fails on tags that do not match, collects words and addresses."""

    def __init__(self, text):
        super().__init__()
        self.open, self.words, self.addresses, self.tags = [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value for key, value in attrs if key in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


@pytest.fixture
def done(mission, execute, script):
    spec = mission(["a drone A 0 0", "b wheeled B 3 0"], ["A OR 0 1", "B OR 2 0"],
                   events=[{"at_decision": 1, "slow": {"robot": "a", "factor": 0.5}}])
    execution = execute(spec, script("right stay", "left left", "up stay"))
    report = make_report(execution.record, spec, Frame((4, 4), 1.0), [0, 7], planner="exact",
                         objective="makespan", mode="barrier", backend="native", seed=3,
                         grid_plan=GridPlan(True, 2, 2))
    return report, Story(spec, execution.record, Frame((4, 4), 1.0), [0, 7])


def test_a_rollouts_page_is_whole_and_needs_nothing_else(done, tmp_path):
    report, story = done
    (tmp_path / "video.mp4").write_bytes(b"moving pictures")
    text = page.rollout_page(
        report, command="moonteam rollout demo", made=tmp_path / "video.mp4", out=tmp_path,
        replans=[(r.time_s, r.decision, r.words) for r in story.replans],
        plots=[("When", plots.timeline(story)), ("Motion", plots.motion(story, [0, 7]))])
    read = Reader(text)
    assert all(address.startswith("data:") for address in read.addresses)
    assert "@import" not in text
    assert {"video", "img", "table"} <= set(read.tags)
    for word in ("success", "2 of 2", "a slowed", "moonteam rollout demo", "T1", "wheeled"):
        assert word in read.text


def test_skills_stand_as_in_the_pictures(done, tmp_path):
    """Letters close together, names apart."""
    report, _ = done
    replace = msgspec.structs.replace
    first, second = report.targets
    robot, other = report.robots
    text = Reader(page.rollout_page(replace(
        report, targets=(replace(first, skills=("camera", "radio"), type="AND"),
                         replace(second, skills=("A", "B"), type="OR")),
        robots=(replace(robot, skills=("camera", "radio")), replace(other, skills=("A", "B")))),
        command="", made=None, out=tmp_path)).text
    for words in (" camera + radio ", " A/B ", " camera, radio ", " AB "):
        assert words in text


def test_words_from_outside_are_escaped():
    assert markup.cell("<b>&") == "&lt;b&gt;&amp;"
    assert markup.cell(markup.Raw("<b>")) == "<b>"
    assert "<script>" not in page.page("<script>", [markup.table(["<script>"], [["<script>"]])])


def test_cells_for_a_person():
    assert markup.cell(1234.567) == "1,234.57"
    assert "-" in markup.cell(None)
    assert "-" in markup.cell(float("nan"))
    assert "yes" in markup.cell(True)
    assert 'class="n"' in markup.table(["x"], [[1.0], [None]])
    assert 'class="n"' not in markup.table(["x"], [[1.0], ["one"]])


def test_a_large_video_is_linked_and_a_missing_one_said(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "LARGEST_VIDEO", 10)
    file = tmp_path / "deep" / "video.mp4"
    file.parent.mkdir()
    file.write_bytes(b"0" * 11)
    assert 'href="deep/video.mp4"' in page.video(file, tmp_path)
    assert "No video" in page.video(None, tmp_path)


def row(number, contender, success, seconds, cause=None):
    return {"number": number, "contender": contender, "site": "mare", "site_seed": 0,
            "report": {"success": success, "seconds": seconds, "inflation": 1.5 if success
                       else None, "cause": cause, "detail": "T1 & T2 not solved"}}


MISSION = {"map": {"size": [8, 8], "cell_m": 1.0}, "name": "flat-0-17",
           "site": {"preset": "flat"},
           "robots": [{"name": "a", "kind": "drone", "skills": ["A"], "start": [0, 0]},
                      {"name": "b<", "kind": "wheeled", "skills": ["B"], "start": [3, 0]}],
           "targets": [{"at": [0, 5], "skills": ["A"]}, {"at": [7, 5], "skills": ["A", "B"],
                                                         "type": "AND", "service": 5.0}]}


@pytest.fixture
def clocked(document):
    """Two missions by the clock, one of them also by the exact planner."""
    def report(planner, expected, seconds, solved):
        robots = [{"name": n, "lost": None, "lost_s": None} for n in ("a", "b<")]
        targets = [
            {"name": "T1", "at": [0, 5], "skills": ["A"], "type": "OR", "solved": True,
             "time_s": 8.0, "expected_s": 7.5, "robots": ["a"]},
            {"name": "T2", "at": [7, 5], "skills": ["A", "B"], "type": "AND", "solved": solved,
             "time_s": seconds if solved else None, "expected_s": expected,
             "robots": ["a", "b<"] if solved else []}]
        return {"success": solved, "seconds": seconds, "inflation": None, "decisions": 2,
                "planner": planner, "objective": "makespan", "grid_plan": None,
                "cause": None if solved else "max_seconds", "detail": "", "targets": targets,
                "expected_s": expected, "robots": robots}

    def line(number, contender, *told):
        return {"number": number, "contender": contender, "site": "mare", "site_seed": 0,
                "nominal_s": None, "report": report(*told)}

    names = ("closed exact clock", "closed greedy clock")
    return document | {
        "contenders": [{"name": name, "loop": "closed"} for name in names],
        "summary": [document["summary"][0] | {"contender": name} for name in names],
        "missions": [{"number": 17, "mission": MISSION}, {"number": 18, "mission": MISSION}],
        "rows": [line(17, names[0], "exact", 20.0, 22.0, True),
                 line(17, names[1], "greedy", 30.0, 33.0, True),
                 line(18, names[1], "greedy", 31.0, 40.0, False)]}


@pytest.fixture
def document():
    summary = {"site": "mare", "site_seed": 0, "contender": "closed exact barrier", "solved": 1,
               "missions": 2, "falls": 1, "stuck": 0, "replans_by_cause": {"wrong_cell": 3},
               "success": 0.5, "seconds": 40.0, "intervals": {"success": [0.0, 1.0],
                                                               "seconds": [None, None]}}
    return {
        "title": "executions in physics", "meta": {"command": "moonteam evaluate execution"},
        "options": {}, "contenders": [{"name": "closed exact barrier", "loop": "closed"},
                                      {"name": "grid exact", "loop": "grid"}],
        "summary": [summary], "comparisons": [], "notes": ["a note"], "missions": [{}, {}],
        "failures": [{"site": "mare", "site_seed": 0, "contender": "closed exact barrier",
                      "causes": {"max steps: legged fallen": [17]}}],
        "rows": [row(3, "closed exact barrier", True, 40.0),
                 row(17, "closed exact barrier", False, 90.0, "max_steps"),
                 row(17, "grid exact", False, 9.0, "max_steps")]}


def test_the_evaluations_page_names_every_failure_and_the_command_that_shows_it(document):
    read = Reader(evaluation_page(document, "runs/x/report.json"))
    assert all(address.startswith("data:") for address in read.addresses)
    command = "moonteam rollout --from runs/x/report.json --mission 17 --contender " \
        "'closed exact barrier'"
    assert read.text.count(command) == 1, "what has no physics has no video"
    for word in ("0.500 [0.000, 1.000]", "max steps: legged fallen", "T1 & T2 not solved",
                 "wrong cell 3", "a note"):
        assert word in read.text


def test_an_evaluation_without_failures_or_rows_is_still_a_page(document):
    document |= {"rows": [], "summary": [], "failures": [], "interrupted": True}
    assert "Interrupted" in Reader(evaluation_page(document)).text


def test_every_mission_has_a_map_a_gantt_and_its_film_on_demand(clocked):
    text = evaluation_page(clocked, "runs/x/report.json")
    read = Reader(text)
    assert text.count('class="map"') == text.count('aria-label="who did what when"') == 3
    assert text.count('href="#ground0"') == 3, "one ground, drawn once"
    assert read.text.count("--out runs/x/films/17-closed-exact-clock") == 1
    assert "b&lt;" in text
    assert "b<</text>" not in text
    for mark in ("plan: 30.0 s", "optimum: 20.0 s", "planned 7.5 s", "T2 solved at 33.0 s"):
        assert mark in read.text


def test_missions_on_two_pieces_of_one_model_have_a_ground_each(clocked):
    """Here it is not to be had, so each is grey."""
    for entry, centre in zip(clocked["missions"], ([3, 4], [9, 4]), strict=True):
        entry["mission"] = MISSION | {"site": {"dem": "none.tif", "centre": centre}}
    text = evaluation_page(clocked)
    assert [text.count(f'href="#ground{k}"') for k in range(3)] == [2, 1, 0]


def test_missions_that_were_given_have_no_seed_of_a_ground(document):
    for part in ("summary", "failures", "rows"):
        document[part] = [one | {"site": GIVEN} for one in document[part]]
    text = Reader(evaluation_page(document)).text
    assert GIVEN in text
    assert f"{GIVEN} 0" not in text


def test_the_optimum_stands_beside_the_plan_where_the_exact_planner_was_asked(clocked):
    assert optimum([row for row in clocked["rows"] if row["number"] == 17], "seconds") == 20.0
    assert optimum([row for row in clocked["rows"] if row["number"] == 18], "seconds") is None
    means = best_means(clocked)
    assert means == {("mare", 0, name): 20.0 for name in (
        "closed exact clock", "closed greedy clock")}


def test_in_steps_the_optimum_is_in_decisions():
    row = {"report": {"planner": "exact", "objective": "makespan", "expected_s": None,
                      "grid_plan": {"makespan": 12}}}
    assert optimum([row], "decisions") == 12
    row["report"]["objective"] = "total_moves"
    assert optimum([row], "decisions") is None


@needs_chromium
@pytest.mark.parametrize("size", [(1280, 1600), (390, 1600)])
def test_the_evaluations_page_needs_no_sideways_scroll(clocked, tmp_path, size):
    seen = visit(evaluation_page(clocked, "runs/x/report.json"), tmp_path, """
        found.wide = [...document.querySelectorAll('.wide, pre')].filter(
          one => one.scrollWidth > one.clientWidth + 1).length;""", size=size)
    assert seen.complaints == []
    assert seen.fits
    assert seen.found["width"] == size[0]
    assert seen.found["wide"] == 0
    assert seen.picture.stat().st_size > 20_000


@needs_chromium
def test_a_film_that_was_made_plays_in_its_mission(clocked, tmp_path):
    film = tmp_path / "films" / "17-closed-exact-clock" / "video.mp4"
    film.parent.mkdir(parents=True)
    with video.writing(film, (64, 64), 10, crf=30) as add:
        for shade in range(5):
            add(np.full((64, 64, 3), 50 * shade, np.uint8))
    seen = visit(evaluation_page(clocked, "runs/x/report.json"), tmp_path, """
        for (const one of document.querySelectorAll('.film')) one.open = true;
        const films = () => [...document.querySelectorAll('.film video')].map(
          one => one.getAttribute('src'));
        const begun = Date.now();
        while (!films().length && Date.now() < begun + 20000)
          await new Promise(go => setTimeout(go, 50));
        found.films = films();""", size=(1280, 900))
    assert seen.found["films"] == ["films/17-closed-exact-clock/video.mp4"]


def test_robots_keep_their_colours_to_themselves():
    assert not set(plots.SERIES) & set(ROBOTS)


def test_a_robot_has_one_hue_in_films_and_on_paper():
    def hue(red, green, blue):
        return 360 * colorsys.rgb_to_hls(red / 255, green / 255, blue / 255)[0]

    for film, paper in zip(ROBOTS, figure.COLOURS, strict=True):
        assert hue(*film) == pytest.approx(hue(*bytes.fromhex(paper[1:])), abs=2.0)


def test_paths_have_axes_a_scale_starts_and_plans(done, tmp_path):
    _, story = done
    shown = plots.paths(story, Ground(np.zeros((17, 17)), 0.25), np.eye(4, dtype=bool))
    axis = shown.axes[0]
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("east, m", "north, m")
    assert axis.get_xlim() == (-2.0, 2.0)
    said = {text.get_text() for text in axis.texts}
    assert {"0.5 m", "T1 A", "T2 B"} <= said
    legend = [text.get_text() for text in axis.get_legend().get_texts()]
    assert legend == ["a", "b", "planned", "driven", "start"]
    plots.save_png(shown, tmp_path / "paths.png")
    assert (tmp_path / "paths.png").stat().st_size > 5_000


def test_plots_are_the_same_for_the_same_data():
    groups = {"one": [1.0, 2.0, 2.5], "two": [2.0]}
    first = plots.histograms("seconds", groups)
    assert first == plots.histograms("seconds", groups)
    assert re.match(r"<\?xml.*<svg", first, re.DOTALL)
    assert plots.histograms("seconds", {"none": []}) == ""
    line = {"a": [(0.0, (1.0, 0.9, 1.0)), (1.0, None)]}
    assert "<svg" in plots.svg(plots.curves([("slope", line, line)]))


def test_plots_of_a_long_record_stay_small(done):
    _, story = done
    story.times = np.linspace(0, 1, 10_000)
    assert len(plots._thinned(len(story.times))) == plots.MOST_POINTS
