"""What mkdocs needs beside the pages as they stand: notebooks, and what they link to outside docs.

Pages are written for the repository: they link to notebooks and to files beside docs/. Here a
notebook becomes a page, with the outputs that are stored in it; a file or folder of the
repository that some page links to becomes a page under repository/; and links follow.
"""

from __future__ import annotations

import base64
import json
import os
import re
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

DOCS = Path(__file__).parent
TOP = DOCS.parent
LINK = re.compile(r"(?<=\]\()(?P<to>[^()\s#]+)(?P<anchor>#[^()\s]*)?(?=\))")
ALWAYS = ("CONTRIBUTING.md", "CHANGELOG.md")
"""Of the repository, in the navigation."""
LANGUAGES = {".py": "python", ".yaml": "yaml", ".xml": "xml", ".toml": "toml", ".sh": "sh",
             ".json": "json"}
ROW = re.compile(r"(?m)^\|.*$")
KEPT = re.compile(r"(?<=[\d%],) (?=[-+\d.]+ ?%?\])|(?<=\d) (?=%|(?:us|ms|s|MB)\b)")
"""Spaces of `[1.6, 2.8]`, `2.8 %` and `3 ms`."""
NO_BREAK = "\u00a0"
COLOURS = re.compile(r"\x1b\[[0-9;]*m")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Pages beside this file that the navigation does not name are guides."""
    nav: list[dict[str, Any]] = config.nav or []
    named = set(re.findall(r"[\w./-]+\.md", json.dumps(nav)))
    guides = next(section["Guides"] for section in nav if "Guides" in section)
    guides += [page.name for page in sorted(DOCS.glob("*.md")) if page.name not in named]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages that are made, and what they show."""
    for notebook in sorted(DOCS.glob("tutorials/*.ipynb")):
        _add_notebook(files, config, notebook)
    waiting, seen = [TOP / name for name in ALWAYS], set[Path]()
    for page in sorted(DOCS.rglob("*.md")):
        waiting += _outside(page.read_text(encoding="utf-8"), page)
    while waiting:
        path = waiting.pop()
        if path not in seen:
            seen.add(path)
            waiting += _add_outside(files, config, path)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links as the site has them, in place of those that the repository has."""
    here = PurePosixPath(page.file.src_uri)
    source = TOP / here.relative_to("repository") if here.parts[0] == "repository" else DOCS / here

    def follow(link: re.Match[str]) -> str:
        to = _target(link["to"], source)
        if to is None:
            return link[0]
        if to.suffix == ".ipynb":
            to = to.with_suffix(".md")
        uri = to.relative_to(DOCS).as_posix() if DOCS in to.parents else _uri(to)
        return os.path.relpath(uri, here.parent) + (link["anchor"] or "")

    if here.parts[0] == "results":  # wide tables: no contents beside them, no breaks in intervals
        page.meta["hide"] = ["toc"]
        markdown = ROW.sub(lambda row: KEPT.sub(NO_BREAK, row[0]), markdown)
    return LINK.sub(follow, markdown)


def _target(link: str, source: Path) -> Path | None:
    """The file or folder that a link of a file of the repository leads to, if there is one."""
    if ":" in link or link.startswith("/"):
        return None
    to = Path(os.path.normpath(source.parent / unquote(link)))
    return to if TOP in to.parents and to.exists() else None


def _outside(text: str, source: Path) -> list[Path]:
    """What a text links to that is in the repository and not in docs."""
    found = [_target(link["to"], source) for link in LINK.finditer(text)]
    return [to for to in found if to is not None and DOCS not in to.parents and to != DOCS]


def _uri(path: Path) -> str:
    """Where the site has a file or folder from outside docs."""
    name = path.relative_to(TOP).as_posix()
    return f"repository/{name}" if path.suffix in {".md", ".png"} else f"repository/{name}.md"


def _add_outside(files: Files, config: MkDocsConfig, path: Path) -> list[Path]:
    """Adds a page of a file or folder; what it links to in turn."""
    if path.suffix == ".png":
        files.append(File.generated(config, _uri(path), abs_src_path=str(path)))
        return []
    if path.suffix == ".md":
        text = path.read_text(encoding="utf-8")
        files.append(File.generated(config, _uri(path), content=text))
        return _outside(text, path)
    shown = [path] if path.is_file() else [
        one for one in sorted(path.iterdir()) if one.suffix in LANGUAGES]
    body = [f"# {path.relative_to(TOP).as_posix()}"]
    for one in shown:
        body += [f"## {one.name}"] if path.is_dir() else []
        code = one.read_text(encoding="utf-8").rstrip()
        body.append(f"````{LANGUAGES.get(one.suffix, 'text')}\n{code}\n````")
    files.append(File.generated(config, _uri(path), content="\n\n".join(body) + "\n"))
    return []


def _add_notebook(files: Files, config: MkDocsConfig, path: Path) -> None:
    """Adds a notebook's page and its pictures."""
    body, pictures = notebook_page(path)
    uri = path.relative_to(DOCS).with_suffix(".md").as_posix()
    files.append(File.generated(config, uri, content=body))
    for name, data in pictures.items():
        where = (PurePosixPath(uri).parent / name).as_posix()
        files.append(File.generated(config, where, content=data))


def notebook_page(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook in Markdown, and its pictures by name."""
    pictures: dict[str, bytes] = {}
    body = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"]).strip()
        if cell["cell_type"] == "markdown":
            body.append(text)
        elif text:
            body.append(f"```python\n{text}\n```")
            body += [_shown(output, path.stem, pictures) for output in cell["outputs"]]
    body.append(f"[The notebook]({path.name}){{: download }}, which the tests execute.")
    return "\n\n".join(body) + "\n", pictures


def _shown(output: dict[str, Any], stem: str, pictures: dict[str, bytes]) -> str:
    """One output of a cell; pictures are added to those there are."""
    data = output.get("data", {})
    if "image/png" in data:
        name = f"{stem}-{len(pictures) + 1}.png"
        pictures[name] = base64.b64decode("".join(data["image/png"]))
        width = output.get("metadata", {}).get("image/png", {}).get("width", 640)
        return f"![What the cell above shows]({name}){{: width={width} }}"
    if "text/html" in data:
        return "".join(data["text/html"])
    text = "".join(output.get("text", data.get("text/plain", "")))
    return f"```text\n{COLOURS.sub('', text).rstrip()}\n```"
