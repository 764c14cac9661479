"""Viser at `/viser/`: its client, and the WebSocket of the private server, whose secret only this process knows."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from urllib.parse import quote, urlencode

import viser
import websockets
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.asyncio.client import ClientConnection, connect

from ..scene.guarded_server import HEADER
from .http import PAGE
from .streams import serve

CLIENT = Path(viser.__file__).parent / "client" / "build" / "index.html"
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

    async def page(self, request: Request) -> Response:
        """Answer with Viser's client, which is one file."""
        # In the text, as a frame under another name may fetch no more.
        own = b"<script>" + SCRIPT.read_bytes() + b"</script>" + SCENE_ALONE
        return HTMLResponse(CLIENT.read_bytes().replace(HTML_HEAD, HTML_HEAD + own, 1))

    async def websocket(self, browser: WebSocket) -> None:
        """Couple a browser's WebSocket with one of Viser's, until either closes."""
        # The pass is for the access control alone.
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
