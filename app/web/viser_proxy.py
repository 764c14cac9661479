"""Passes `/viser/...` through to the private Viser server, whose secret only this process knows."""

from __future__ import annotations

import http.client
from collections.abc import Mapping
from contextlib import suppress
from urllib.parse import quote, urlencode

import websockets
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.asyncio.client import ClientConnection, connect

from ..views.viser.guarded_server import HEADER
from .http import PAGE
from .request_threads import in_thread
from .streams import serve

RESPONSE_HEADERS = ("content-type", "content-encoding", "etag", "last-modified", "cache-control")
REQUEST_HEADERS = ("accept", "accept-encoding", "if-none-match")
HTML_HEAD = b"<head>"
SCRIPT = PAGE / "viser_frame.js"

SCENE_ALONE = b"""<style>
  [data-dock-region], [data-dock-region-handle], [data-floating-window], .mantine-Paper-root,
  .mantine-Notifications-root { display: none !important; }
  [data-dock-root] > div { inset: 0 !important; width: 100% !important; }
</style>"""
"""Viser's own panel is hidden; the page has the controls."""

MAX_MESSAGE_BYTES = 256 * 2**20
"""Largest message; a scene's first one holds all its point clouds."""

MAX_QUEUED_MESSAGES = 4
"""Messages of Viser that may wait for a slow browser; Viser then holds its own back, and drops outdated ones."""


class ViserProxy:
    """Speaks to one Viser server on a loopback port."""

    def __init__(self, port: int, secret: str) -> None:
        self._port = port
        self._secret = secret

    async def http(self, request: Request) -> Response:
        """Fetch a file of Viser's client."""
        path = "/" + quote(request.path_params["path"])
        # The page uncompressed and not from a cache, as it is changed here.
        asked = {} if path == "/" else dict(request.headers)
        try:
            status, headers, body = await in_thread(self._fetch, path, asked)
        except (OSError, http.client.HTTPException) as error:
            return PlainTextResponse(f"Nisus: the Viser pane does not answer ({error}).\n", 502)
        if path == "/":
            # In the text, as a frame under another name may fetch no more.
            script = b"<script>" + SCRIPT.read_bytes() + b"</script>"
            body = body.replace(HTML_HEAD, HTML_HEAD + script + SCENE_ALONE, 1)
        answer = Response(body, status)
        for name, value in headers:
            if name.lower() in RESPONSE_HEADERS and not (path == "/" and name.lower() == "etag"):
                answer.headers[name] = value
        return answer

    def _fetch(self, path: str, headers: dict[str, str]) -> tuple[int, list[tuple[str, str]], bytes]:
        wanted = {name: value for name, value in headers.items() if name in REQUEST_HEADERS}
        connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=30.0)
        try:
            connection.request("GET", path, headers=wanted | {HEADER: self._secret})
            answer = connection.getresponse()
            return answer.status, answer.getheaders(), answer.read()
        finally:
            connection.close()

    async def websocket(self, browser: WebSocket) -> None:
        """Couple a browser's WebSocket with one of Viser's, until either closes."""
        # The pass is for the gate alone.
        query = urlencode([(name, value) for name, value in browser.query_params.multi_items() if name != "pass"])
        path = quote(browser.path_params.get("path", ""))
        url = f"ws://127.0.0.1:{self._port}/{path}" + (f"?{query}" if query else "")
        await couple(browser, url, {HEADER: self._secret})


async def couple(browser: WebSocket, url: str, headers: Mapping[str, str], origin: str | None = None) -> None:
    """Couple a browser's WebSocket with one of another server, until either closes."""
    offered = [websockets.Subprotocol(name) for name in browser.scope.get("subprotocols", [])]
    try:
        server = await connect(
            url, additional_headers=headers, subprotocols=offered or None, compression=None,
            origin=None if origin is None else websockets.Origin(origin),
            max_size=MAX_MESSAGE_BYTES, max_queue=MAX_QUEUED_MESSAGES, ping_interval=None, proxy=None,
        )  # fmt: skip
    except (OSError, websockets.WebSocketException):
        await browser.close(1013)
        return
    async with server:
        await browser.accept(subprotocol=server.subprotocol)
        await serve(browser, _up(browser, server), _down(browser, server))


async def _up(browser: WebSocket, server: ClientConnection) -> None:
    with suppress(websockets.ConnectionClosed):
        while (message := await browser.receive())["type"] != "websocket.disconnect":
            data = message.get("bytes")
            await server.send(data if data is not None else message["text"])


async def _down(browser: WebSocket, server: ClientConnection) -> None:
    with suppress(WebSocketDisconnect, websockets.ConnectionClosed, RuntimeError):
        async for message in server:
            await (browser.send_text(message) if isinstance(message, str) else browser.send_bytes(message))
        await browser.close(server.close_code or 1000)
