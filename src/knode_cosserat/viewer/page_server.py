"""Server of a live page and its connections: for this machine, its own page, and a few pages at once."""

from __future__ import annotations

import asyncio
import contextlib
import http
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from knode_cosserat.viewer.connection import PageSession
from knode_cosserat.viewer.serve import HOST, Opening, announce, own_names

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

#: most pages that are open at once: each solves its own steps; others are answered 503
MOST_PAGES = 4
#: connections that are accepted at once: the open pages are served in between
BACKLOG = 8
#: time after which a page is turned away while all places are taken (s), and most of them that wait for it:
#: those who come back at once would take the processor from the open pages
REFUSAL, MOST_REFUSALS = 3.0, 400


async def serve_page(
    page: bytes, session: Callable[[Any], PageSession], port: int, open_browser: Opening
) -> None:
    """Serve a page and the connections of its open copies, each with its session, until cancelled."""
    from websockets.asyncio.server import serve

    pages = PageServer(page, session)
    async with serve(
        pages.run, HOST, port, process_request=pages.answer, compression=None, backlog=BACKLOG
    ) as server:
        number = next(iter(server.sockets)).getsockname()[1]
        pages.names = own_names(number)
        announce(f"http://{HOST}:{number}/", open_browser)
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.get_running_loop().create_future()


class PageServer:
    """Answers of the server, and its open pages."""

    def __init__(self, page: bytes, session: Callable[[Any], PageSession]):
        self._page, self._session = page, session
        #: names under which it answers
        self.names: tuple[str, ...] = ()
        self._opened: set[Any] = set()
        self._refusals = 0

    async def answer(self, connection: Any, request: Request) -> Response | None:
        """Return the answer to a request; None opens a connection."""
        found = self._answer(connection, request)
        full = len(self._opened) >= MOST_PAGES
        if found is not None and full and self._refusals < MOST_REFUSALS:
            self._refusals += 1
            try:
                await asyncio.sleep(REFUSAL)
            finally:
                self._refusals -= 1
        return found

    async def run(self, connection: ServerConnection) -> None:
        """Run the session of an open connection."""
        from websockets.exceptions import ConnectionClosed

        if len(self._opened) >= MOST_PAGES:  # several came together
            await connection.close(1013, "too many pages")
            return
        self._opened.add(connection)
        try:
            with contextlib.suppress(ConnectionClosed):
                await self._session(connection).run()
        finally:
            self._opened.discard(connection)

    def _answer(self, connection: Any, request: Request) -> Response | None:
        # a name that somebody made to point here
        if request.headers.get_all("Host") not in ([name] for name in self.names):
            return _response(403, "Forbidden", b"")
        path = request.path.split("?")[0]
        # another page of the browser must not reach it
        if path == "/live" and request.headers.get("Origin") not in [f"http://{name}" for name in self.names]:
            return _response(403, "Forbidden", b"another origin\n")
        if path not in ("/live", "/", "/index.html"):
            refused: Response = connection.respond(http.HTTPStatus.NOT_FOUND, "not found\n")
            return refused
        if len(self._opened) >= MOST_PAGES:
            text = f"{MOST_PAGES} pages of this robot are open; close one, then load this page again\n"
            return _response(503, "Service Unavailable", text.encode())
        kind = "text/html; charset=utf-8"
        return None if path == "/live" else _response(200, "OK", self._page, kind)


def _response(status: int, reason: str, body: bytes, kind: str = "text/plain") -> Response:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    headers = Headers({
        "Content-Type": kind, "Content-Length": str(len(body)),
        "Cache-Control": "no-store", "Connection": "close",
    })  # fmt: skip
    return Response(status, reason, headers, body)
