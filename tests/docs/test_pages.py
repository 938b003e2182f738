"""The pages: built strictly, whole, without the network; every figure says where it is from."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from moonteam import cli

TOP = Path(__file__).parents[2]
DOCS = TOP / "docs"
RESULTS = sorted((DOCS / "results").glob("*.md"))
BLOCK = re.compile(r"<!-- run: ([^\n]*?) -->\n(.*?)<!-- end -->", re.DOTALL)
LOADED = re.compile(r'<(?:script|img|iframe|source)\b[^>]*?\bsrc="([^"]*)"|'
                    r'<link\b[^>]*?\brel="(?:stylesheet|preload|icon|preconnect)"[^>]*?\bhref="([^"]*)"|'
                    r'<link\b[^>]*?\bhref="([^"]*)"[^>]*?\brel="(?:stylesheet|preload|icon|preconnect)"')
STYLED = re.compile(r"url\(\s*['\"]?(https?:[^)'\"]*)")
CUT = """
import sys

def hook(event, args):
    if event in {"socket.connect", "socket.getaddrinfo"}:
        raise OSError(101, "the network is cut")

sys.addaudithook(hook)
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The pages, built as `make docs` builds them, by a process without a network."""
    folder = tmp_path_factory.mktemp("pages")
    (folder / "sitecustomize.py").write_text(CUT)
    paths = [str(folder), *filter(None, [os.environ.get("PYTHONPATH")])]
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", folder / "site"],
        cwd=TOP, capture_output=True, text=True, check=False, env=os.environ | {
            "PYTHONPATH": os.pathsep.join(paths), "NO_MKDOCS_2_WARNING": "1"})
    assert done.returncode == 0, done.stderr
    assert done.stdout + done.stderr == ""
    return folder / "site"


def test_pages_load_nothing_from_elsewhere(site):
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 40
    for page in pages:
        for found in LOADED.finditer(page.read_text(encoding="utf-8")):
            address = next(filter(None, found.groups()))
            assert not re.match(r"(\w+:)?//", address), (page.name, address)
            if not address.startswith("data:"):
                where = (page.parent / address.split("?")[0].split("#")[0]).resolve()
                assert where.exists() or page.name == "404.html", (page.name, address)
    for style in site.rglob("*.css"):
        assert not STYLED.search(style.read_text(encoding="utf-8")), style


def test_no_page_names_this_machine(site):
    for page in site.rglob("*.html"):
        assert str(TOP) not in page.read_text(encoding="utf-8"), page


def test_what_is_public_is_in_the_api(site):
    import moonteam

    shown = "".join(page.read_text(encoding="utf-8") for page in (site / "api").glob("*.html"))
    for name in set(moonteam.__all__) - {"__version__"}:
        assert re.search(rf'id="moonteam\.(?:\w+\.)*{name}"', shown), name


def test_notebooks_and_outside_files_are_pages(site):
    text = (site / "tutorials/plan-and-execute.html").read_text(encoding="utf-8")
    assert 'src="plan-and-execute-1.png"' in text
    assert (site / "tutorials/plan-and-execute.ipynb").exists()
    assert "class ScoutState" in re.sub(
        "<[^>]*>", "", (site / "repository/examples/scout.html").read_text(encoding="utf-8"))
    assert 'href="tutorials/train.html"' in (site / "jobs.html").read_text(encoding="utf-8")
    assert "results/physics.html" in (site / "robots.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_every_table_says_how_where_and_at_which_commit(path):
    text = path.read_text(encoding="utf-8")
    assert text.count("<!-- run: ") == text.count("<!-- end -->") == len(BLOCK.findall(text))
    for command, table in BLOCK.findall(text):
        assert re.search(r"(?m)^`moonteam .*`$", table), command
        assert re.search(r"(?m)^\|", table), command
        source = r"(?m)^- commit [0-9a-f]{12}(-dirty)?, seed .* cores? of .*JAX"
        assert re.search(source, table), command


def test_every_page_of_results_is_in_the_index():
    index = (DOCS / "results/index.md").read_text(encoding="utf-8")
    for path in RESULTS:
        assert path.name == "index.md" or f"({path.name})" in index, path.name


COMMANDS = [
    pytest.param(line, id=f"{page}-{number}")
    for page in ("README.md", "docs/quickstart.md", "docs/jobs.md", "docs/own/robot.md",
                 "docs/planners.md", "docs/own/ground.md")
    for block in re.findall(r"```sh\n(.*?)```", (TOP / page).read_text(encoding="utf-8"), re.DOTALL)
    for number, line in enumerate(re.findall(r"(?m)^moonteam [^-].*$", block))]


@pytest.mark.parametrize("line", COMMANDS)
def test_commands_of_the_pages_are_understood(line):
    name, words = cli.find_command(shlex.split(line, comments=True)[1:])
    cli.parse(name, words)


def test_the_two_commands_of_the_readme_are_what_ci_runs():
    told = re.findall(r"(?m)^make (\w+)", (TOP / "README.md").read_text(encoding="utf-8"))
    assert told == ["demo", "test"]
    for name in told:
        assert f"time make {name}\n" in (TOP / ".ci/run").read_text(encoding="utf-8")
        assert f"\n{name}: " in (TOP / "Makefile").read_text(encoding="utf-8")
