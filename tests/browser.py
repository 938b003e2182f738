"""A page seen by Chromium without a screen: what it says of itself, what it complains of, how it
looks. Chromium's own switches do (no driver to keep): a script is put into a copy of the page.
"""

import html
import json
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

CHROMIUM = Path("/usr/bin/chromium")
needs_chromium = pytest.mark.skipif(not CHROMIUM.exists(), reason="needs /usr/bin/chromium")

SWITCHES = (
    "--headless", "--no-sandbox", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--hide-scrollbars", "--use-gl=angle",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--host-resolver-rules=MAP * ~NOTFOUND")  # no network, whatever a page asks for

LISTENS = """<script>
const complaints = [];
addEventListener('error', e => complaints.push(e.message));
addEventListener('unhandledrejection', e => complaints.push(String(e.reason)));
for (const kind of ['error', 'warn']) {
  const before = console[kind];
  console[kind] = (...words) => { complaints.push(words.join(' ')); before(...words); };
}
const found = {};
</script>"""

TELLS = """<script>addEventListener('load', async () => {
  try { %s } catch (error) { complaints.push(String(error)); }
  const its = document.documentElement;
  Object.assign(found, { complaints, width: its.clientWidth, needed: its.scrollWidth });
  parent.postMessage(JSON.stringify(found), '*');
});</script>"""

# A window cannot be as narrow as a telephone: the page stands in a frame that can.
FRAME = """<!DOCTYPE html><body style="margin:0"><iframe src="page.html" width="%d" height="%d"
style="border:0"></iframe><pre id="found"></pre><script>addEventListener('message', e => {
document.getElementById('found').textContent = e.data; });</script></body>"""


@dataclass(frozen=True)
class Seen:
    """What came of a visit: `found` as the script left it, and the picture."""

    found: dict
    picture: Path

    @property
    def complaints(self):
        return self.found["complaints"]

    @property
    def fits(self):
        return self.found["needed"] <= self.found["width"]


def visit(text, folder, script="", size=(1280, 900), budget_ms=4000):
    """Opens a page from a file and runs `script` (it may await) once the page has loaded."""
    folder.mkdir(parents=True, exist_ok=True)
    copy = text.replace("<head>", "<head>" + LISTENS, 1)
    (folder / "page.html").write_text(copy.replace("</body>", TELLS % script + "</body>", 1))
    (folder / "frame.html").write_text(FRAME % size)
    picture = folder / f"{size[0]}.png"
    done = subprocess.run(
        [str(CHROMIUM), *SWITCHES, f"--user-data-dir={folder / 'profile'}", "--dump-dom",
         f"--window-size={max(size[0], 500)},{size[1]}", f"--screenshot={picture}",
         f"--virtual-time-budget={budget_ms}", (folder / "frame.html").as_uri()],
        capture_output=True, text=True, timeout=300, check=True)
    words = done.stdout.partition('<pre id="found">')[2].partition("</pre>")[0]
    assert words, done.stderr[-2000:]
    return Seen(json.loads(html.unescape(words)), picture)
