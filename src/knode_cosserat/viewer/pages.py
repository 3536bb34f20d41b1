"""Pages: one self-contained text with files, libraries and scene, and local servers of it.

Servers are reachable from this machine only.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import html
import json
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from knode_cosserat._arguments import check_arguments
from knode_cosserat._files.writing import replacing
from knode_cosserat.viewer.scene import Given, Point, scene

if TYPE_CHECKING:
    from knode_cosserat.recordings.measurements import Measurements
    from knode_cosserat.recordings.recording import Recording

#: folder of this package
HERE = Path(__file__).parent
#: names under which modules import each other, and their files
MODULES = {
    "three": "vendor/three.module.min.js",
    "orbit-controls": "vendor/OrbitControls.js",
    **{f"viewer/{file.stem}": f"page/{file.name}" for file in sorted((HERE / "page").glob("*.js"))},
}
#: security policy of the page: no network access, except to its own server in the live mode
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' data:; style-src 'unsafe-inline'; img-src data:; "
    "base-uri 'none'; form-action 'none'; connect-src "
)


def export_scene(
    trajectories: Given,
    path: str | Path,
    *,
    title: str | None = None,
    target: Point | None = None,
    measured: Recording | Measurements | None = None,
) -> Path:
    """Write trajectories as one HTML file that any browser opens, without a server or a network.

    Args:
        trajectories: a `Trajectory`, several, or several by name; a batch is shown as separate trajectories.
            An `Evaluation` is shown with the measured bodies and the band of its prediction.
        path: the file to write.
        title: heading of the page; by default the names.
        target: position (x, y, z) in m that is marked, with the distance of every tip to it.
        measured: recording that the trajectories predict, row by row; its bodies are drawn beside them.

    Raises:
        ValueError: no trajectory, more than 12, one that has nothing to be drawn, an impossible target, or
            another number of rows than the recording.
    """
    check_arguments(export_scene, locals())
    return write_page(document(scene(trajectories, title, target, measured)), Path(path))


def write_page(text: str, path: Path) -> Path:
    """Write a page to a file, whole or not at all; return its path."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def document(shown: dict[str, Any], connects: str = "'none'") -> str:
    """The page with a scene in it; `connects` says where its security policy lets it connect to."""
    imports = {}
    for name, file in MODULES.items():
        # under its own name in the browser's console, instead of its whole text
        code = (_text(file) + f"\n//# sourceURL=knode-cosserat/{file}\n").encode("utf-8")
        imports[name] = "data:text/javascript;base64," + base64.b64encode(code).decode("ascii")
    parts = {
        "TITLE": html.escape(str(shown["title"])),
        "POLICY": _POLICY + connects,
        "STYLE": _text("vendor/uPlot.min.css") + _text("page/style.css"),
        "PLOTS": _text("vendor/uPlot.iife.min.js"),
        "IMPORTS": for_script({"imports": imports}),
        "SCENE": for_script(shown),
    }
    page = _text("page/index.html")
    # replaced one after the other between marks, so that text in a scene is never taken for a mark
    pieces = page.split("@@")
    return "".join(parts[piece] if k % 2 else piece for k, piece in enumerate(pieces))


def for_script(value: Any) -> str:
    """JSON that is safe within a script of a page: nothing in it ends the script or begins a comment."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _text(file: str) -> str:
    return (HERE / file).read_text(encoding="utf-8")


# servers

HOST = "127.0.0.1"

#: True: open the page and print its address; False: print it only; a function is called with it instead
Opening = bool | Callable[[str], None]


def view(
    trajectories: Given,
    *,
    title: str | None = None,
    target: Point | None = None,
    measured: Recording | Measurements | None = None,
    port: int = 0,
    open_browser: Opening = True,
) -> None:
    """Show trajectories in the browser until interrupted (Ctrl-C).

    Args:
        trajectories: a `Trajectory`, several, or several by name; those of a batch are shown one by one. An
            `Evaluation` is shown with the measured bodies and the band of its prediction.
        title: heading of the page; by default the names.
        target: position (x, y, z) in m that is marked, with the distance of every tip to it.
        measured: recording that the trajectories predict, row by row; its bodies are drawn beside them.
        port: port of the server, which only this machine reaches; 0 for any free one.
        open_browser: True opens the page and prints its address; False only prints it. A function is called
            with the address instead.

    Raises:
        ValueError: no trajectory, more than 12, one that has nothing to be drawn, an impossible target or
            port, or another number of rows than the recording.
        OSError: the port is taken.
    """
    check_arguments(view, locals())
    import http.server

    page = document(scene(trajectories, title, target, measured)).encode("utf-8")

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            # other names that lead here may be a page's of somebody else
            if self.headers.get_all("Host", []) not in (
                [name] for name in server_names(server.server_address[1])
            ):
                self.send_error(421)
                return
            known = self.path.split("?")[0] in ("/", "/index.html")
            body = page if known else b"not found"
            self.send_response(200 if known else 404)
            self.send_header("Content-Type", "text/html; charset=utf-8" if known else "text/plain")
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            pass

    with http.server.ThreadingHTTPServer((HOST, checked_port(port)), Handler) as server:
        announce(f"http://{HOST}:{server.server_address[1]}/", open_browser)
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()


def server_names(port: int) -> tuple[str, ...]:
    """Return the names under which the server answers, as browsers send them."""
    return f"{HOST}:{port}", f"localhost:{port}"


def checked_port(port: int) -> int:
    """Return a valid port, or 0 for any free one; `ValueError` otherwise."""
    if not 0 <= port <= 65535:
        raise ValueError(f"port is {port!r}; allowed is 0 (any that is free) to 65535")
    return port


def announce(address: str, open_browser: Opening) -> None:
    """Report the address of the page, and open it if requested."""
    if callable(open_browser):
        open_browser(address)
        return
    print(f"the viewer is at {address} (Ctrl-C ends it)", file=sys.stderr, flush=True)
    if open_browser:
        webbrowser.open(address)


# the server of live pages

#: most pages that are open at once: each solves its own steps; others are answered 503
MOST_PAGES = 4
#: connections that are accepted at once: the open pages are served in between
BACKLOG = 8
#: time after which a page is turned away while all places are taken (s): one that comes back at once would
#: take the processor from the open pages
REFUSAL = 3.0


async def serve_page(page: bytes, session: Callable[[Any], Any], port: int, open_browser: Opening) -> None:
    """Serve a page and the connections of its open copies until cancelled.

    Each connection has an object by `session`, whose `run` ends with the page.
    """
    from websockets.asyncio.server import ServerConnection, serve
    from websockets.exceptions import ConnectionClosed

    opened: set[ServerConnection] = set()
    names: list[str] = []

    def answered(connection: Any, status: int, text: str, body: bytes | None = None) -> Any:
        response = connection.respond(status, text)
        if body is not None:
            response.body = body
            for key, value in (("Content-Type", "text/html; charset=utf-8"), ("Content-Length", len(body))):
                del response.headers[key]
                response.headers[key] = str(value)
        response.headers["Cache-Control"] = "no-store"
        return response

    async def answer(connection: Any, request: Any) -> Any:
        """Return the answer to a request; None opens a connection."""
        path, origins = request.path.split("?")[0], [f"http://{name}" for name in names]
        if len(opened) >= MOST_PAGES:
            await asyncio.sleep(REFUSAL)
        # a name that somebody made to point here
        if request.headers.get_all("Host") not in ([name] for name in names):
            return answered(connection, 403, "")
        # another page of the browser must not reach it
        if path == "/live" and request.headers.get("Origin") not in origins:
            return answered(connection, 403, "another origin\n")
        if path not in ("/live", "/", "/index.html"):
            return answered(connection, 404, "not found\n")
        if len(opened) >= MOST_PAGES:
            text = f"{MOST_PAGES} pages of this robot are open; close one, then load this page again\n"
            return answered(connection, 503, text)
        return None if path == "/live" else answered(connection, 200, "", page)

    async def run(connection: ServerConnection) -> None:
        if len(opened) >= MOST_PAGES:  # several came together
            await connection.close(1013, "too many pages")
            return
        opened.add(connection)
        try:
            with contextlib.suppress(ConnectionClosed):
                await session(connection).run()
        finally:
            opened.discard(connection)

    async with serve(run, HOST, port, process_request=answer, compression=None, backlog=BACKLOG) as server:
        number = next(iter(server.sockets)).getsockname()[1]
        names += server_names(number)
        announce(f"http://{HOST}:{number}/", open_browser)
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.get_running_loop().create_future()
