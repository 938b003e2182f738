"""Executes the tutorials and stores what they show; the tests execute them with `executed`.

`python docs/run_tutorials.py` takes all, `python docs/run_tutorials.py robot train` those two.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
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


def main() -> None:
    """Stores the outputs of the notebooks that the command line names."""
    for path in sorted(TUTORIALS.glob("*.ipynb")):
        if sys.argv[1:] and path.stem not in sys.argv[1:]:
            continue
        print(path.name, file=sys.stderr)
        with tempfile.TemporaryDirectory() as folder:
            book = executed(path, Path(folder))
        book.metadata = {"kernelspec": book.metadata.kernelspec,
                         "language_info": {"name": "python"}}
        path.write_text(nbformat.writes(book) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
