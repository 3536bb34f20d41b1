"""Local server of the page, reachable from this machine only."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable

from knode_cosserat.viewer.document import document
from knode_cosserat.viewer.scene import Given, Point, scene

HOST = "127.0.0.1"

#: True: open the page and print its address; False: print it only; a function is called with it instead
Opening = bool | Callable[[str], None]


def view(
    trajectories: Given,
    *,
    title: str | None = None,
    target: Point | None = None,
    port: int = 0,
    open_browser: Opening = True,
) -> None:
    """Show trajectories in the browser until interrupted (Ctrl-C).

    Args:
        trajectories: a `Trajectory`, several, or several by name; those of a batch are shown one by one.
        title: heading of the page; by default the names.
        target: position (x, y, z) in m that is marked, with the distance of every tip to it.
        port: port of the server, which only this machine reaches; 0 for any free one.
        open_browser: True opens the page and prints its address; False only prints it. A function is called
            with the address instead.

    Raises:
        ValueError: no trajectory, more than 12, one that has nothing to be drawn, or an impossible target or
            port.
        OSError: the port is taken.
    """
    import http.server

    page = document(scene(trajectories, title, target)).encode("utf-8")

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            # other names that lead here may be a page's of somebody else
            if self.headers.get_all("Host", []) not in (
                [name] for name in own_names(server.server_address[1])
            ):
                self.send_error(421)
                return
            found = self.path.split("?")[0] in ("/", "/index.html")
            body = page if found else b"not found"
            self.send_response(200 if found else 404)
            self.send_header("Content-Type", "text/html; charset=utf-8" if found else "text/plain")
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


def own_names(port: int) -> tuple[str, ...]:
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
        open_page(address)


def open_page(address: str) -> None:
    """Open an address in the default browser."""
    import webbrowser

    webbrowser.open(address)
