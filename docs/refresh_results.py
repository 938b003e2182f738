"""Makes the tables of docs/results/*.md again, each by the command that stands above it.

A table lies between `<!-- run: COMMAND -->` and `<!-- end -->`; the command is run with
`--markdown`, and what it prints replaces the table. With `--figure NAME.png` in the marker
the figure of the run goes to docs/images. Usage, in the environment that has moonteam:

    python docs/refresh_results.py             # all tables
    python docs/refresh_results.py timing 3x7  # those whose command or page holds one of the words
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

PAGES = Path(__file__).parent / "results"
IMAGES = Path(__file__).parent / "images"
BLOCK = re.compile(r"(<!-- run: (?P<command>[^\n]*?) -->\n).*?(?=<!-- end -->)", re.DOTALL)


def made(command: str) -> str:
    """The table that a command prints, with its figure if it asks for one."""
    words = shlex.split(command)
    figure = ""
    if "--figure" in words:
        at = words.index("--figure")
        figure = words[at + 1]
        del words[at:at + 2]
    print(shlex.join(words), file=sys.stderr)
    with tempfile.TemporaryDirectory() as folder:
        extra = ["--out", folder] if figure else []
        program = Path(sys.executable).with_name(words[0])
        done = subprocess.run([program, *words[1:], "--markdown", *extra], text=True,
                              stdout=subprocess.PIPE, check=False)
        if done.returncode not in (0, 1):  # 1: something in the table failed, which it shows
            raise SystemExit(f"{command}: exit code {done.returncode}")
        if figure:
            IMAGES.mkdir(exist_ok=True)
            shutil.copy(next(Path(folder).glob("*.png")), IMAGES / figure)
    picture = f"\n![{Path(figure).stem}](../images/{figure})\n" if figure else ""
    return f"\n{done.stdout}{picture}\n"


def refresh(page: Path, chosen: list[str]) -> None:
    """Replaces a page's blocks that the words choose; saves after each."""
    for found in BLOCK.finditer(page.read_text(encoding="utf-8")):
        command = found["command"]
        if chosen and not any(word in command or word in page.stem for word in chosen):
            continue
        table = made(command)

        def put(block: re.Match[str], command: str = command, table: str = table) -> str:
            return block[1] + table if block["command"] == command else block[0]

        page.write_text(BLOCK.sub(put, page.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    for one in sorted(PAGES.glob("*.md")):
        refresh(one, sys.argv[1:])
