"""A page seen by Chromium without a screen: what it says of itself, what it complains of, how it
looks. Chromium's own switches do (no driver to keep): a script is put into a copy of the page, and
until it has told its findings the page has not loaded, and Chromium takes no picture of it.
"""

import json
import subprocess
import threading
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

CHROMIUM = Path("/usr/bin/chromium")
needs_chromium = pytest.mark.skipif(not CHROMIUM.exists(), reason="needs /usr/bin/chromium")

SWITCHES = (
    "--headless", "--no-sandbox", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--hide-scrollbars", "--use-gl=angle",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1")  # no network but what listens

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
style="border:0"></iframe><script>addEventListener('message', e => {
fetch('%s', { method: 'POST', mode: 'no-cors', body: e.data }); });</script>
<img src="%s" style="display:none"></body>"""

PATIENCE_S = 240


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


def visit(text, folder, script="", size=(1280, 900)):
    """Opens a page from a file and runs `script` (it may await) once the page has loaded."""
    folder.mkdir(parents=True, exist_ok=True)
    copy = text.replace("<head>", "<head>" + LISTENS, 1)
    (folder / "page.html").write_text(copy.replace("</body>", TELLS % script + "</body>", 1))
    picture = folder / f"{size[0]}.png"
    with _listening() as (address, told):
        (folder / "frame.html").write_text(FRAME % (*size, address, address))
        done = subprocess.run(
            [str(CHROMIUM), *SWITCHES, f"--user-data-dir={folder / 'profile'}",
             f"--window-size={max(size[0], 500)},{size[1]}", f"--screenshot={picture}",
             (folder / "frame.html").as_uri()],
            capture_output=True, text=True, timeout=PATIENCE_S + 60, check=True)
    assert told, done.stderr[-2000:]
    return Seen(json.loads(told[0]), picture)


@contextmanager
def _listening():
    """An address that takes what is posted there, and answers who asks only after that."""
    told, heard = [], threading.Event()

    class Ear(BaseHTTPRequestHandler):
        def do_POST(self):
            told.append(self.rfile.read(int(self.headers["Content-Length"])).decode())
            self._answer()
            heard.set()

        def do_GET(self):
            heard.wait(PATIENCE_S)
            self._answer()

        def _answer(self):
            self.send_response(204)
            self.end_headers()

        def log_message(self, *args):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Ear) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/", told
        finally:
            server.shutdown()
