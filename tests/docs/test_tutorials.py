"""The tutorials run from top to bottom, and what is stored in them is what anybody may see."""

import importlib.util
import json
import re
from pathlib import Path

import pytest

TOP = Path(__file__).parents[2]
NOTEBOOKS = sorted((TOP / "docs" / "tutorials").glob("*.ipynb"))


def of_docs(name):
    """A module of the folder docs, which is no package."""
    spec = importlib.util.spec_from_file_location(name, TOP / "docs" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_tutorial_runs(path, tmp_path):
    book = of_docs("run_tutorials").executed(path, tmp_path)
    said = [output for cell in book.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in said)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_what_is_stored_is_whole_and_names_no_machine(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert sum(len(cell["outputs"]) for cell in code) >= 3
    for cell in cells:
        text = json.dumps([cell["source"], [
            {key: value for key, value in output.get("data", output).items() if "/png" not in key}
            for output in cell.get("outputs", ())]])
        assert not re.search(r"/(home|root|tmp|work|Users)/", text), text
        assert "error" not in [output["output_type"] for output in cell.get("outputs", ())]
    assert path.stat().st_size < 400_000


def test_there_are_five():
    listed = re.findall(r"\]\(([\w-]+)\.ipynb\)", (TOP / "docs/tutorials/index.md").read_text())
    assert sorted(listed) == [path.stem for path in NOTEBOOKS]
    assert len(listed) == 5
