"""Executes the tutorials and stores what they show; the tests execute them with `executed`.

`python docs/run_tutorials.py` takes all, `python docs/run_tutorials.py robot train` those two.
"""

from __future__ import annotations

import base64
import io
import shutil
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image
from traitlets.config import Config

TOP = Path(__file__).parents[1]
TUTORIALS = TOP / "docs" / "tutorials"
SECONDS = 1800
"""That a kernel may take to start, and one cell, on a machine however busy."""


def executed(path: Path, workspace: Path) -> nbformat.NotebookNode:
    """A notebook with its outputs, executed in a copy of what it reads under `workspace`.

    Raises nbclient.exceptions.CellExecutionError where a cell does.
    """
    shutil.copytree(TOP / "examples", workspace / "examples",
                    ignore=shutil.ignore_patterns("__pycache__"))
    here = workspace / "docs" / "tutorials"
    here.mkdir(parents=True)
    book = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as sockets:  # of the file system: no port is listened on
        kernel = Config({"KernelManager": {"transport": "ipc", "ip": f"{sockets}/kernel"}})
        NotebookClient(book, timeout=SECONDS, startup_timeout=SECONDS, kernel_name="python3",
                       config=kernel, record_timing=False, coalesce_streams=True,
                       resources={"metadata": {"path": str(here)}}).execute()
    return book


def slim(book: nbformat.NotebookNode) -> None:
    """Makes pictures small enough for a repository: 960 pixels a side, 256 colours.

    Those are chosen to cover what there is: thin lines keep theirs.
    """
    for cell in book.cells:
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if "image/png" in data:
                picture = Image.open(io.BytesIO(base64.b64decode(data["image/png"])))
                file = io.BytesIO()
                picture.thumbnail((960, 960))
                few = picture.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE)
                few.save(file, "PNG", optimize=True)
                data["image/png"] = base64.b64encode(file.getvalue()).decode()


def main() -> None:
    """Stores the outputs of the notebooks that the command line names."""
    for path in sorted(TUTORIALS.glob("*.ipynb")):
        if sys.argv[1:] and path.stem not in sys.argv[1:]:
            continue
        print(path.name, file=sys.stderr)
        with tempfile.TemporaryDirectory() as folder:
            book = executed(path, Path(folder))
        slim(book)
        book.metadata = {"kernelspec": book.metadata.kernelspec,
                         "language_info": {"name": "python"}}
        path.write_text(nbformat.writes(book) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
