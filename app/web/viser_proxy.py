"""Passes `/viser/...` through to the private Viser server, whose secret only this process knows."""

from __future__ import annotations

import asyncio
import http.client
from typing import Any
from urllib.parse import quote, urlencode

import websockets
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.asyncio.client import ClientConnection, connect

from ..views.viser.guarded_server import HEADER
from .http import PAGE

PASSED_ON = ("content-type", "content-encoding", "etag", "last-modified", "cache-control")
ASKED = ("accept", "accept-encoding", "if-none-match")
HEAD = b"<head>"
SCRIPT = PAGE / "viser_frame.js"
AHEAD = "<script>{script}</script>"
"""What goes into Viser's page ahead of its own script; in the text, as a frame under another name may fetch no more."""

SCENE_ALONE = """<style>
  [data-dock-region], [data-dock-region-handle], [data-floating-window], .mantine-Paper-root,
  .mantine-Notifications-root { display: none !important; }
  [data-dock-root] > div { inset: 0 !important; width: 100% !important; }
</style>"""
"""And where the page has all that Viser's panel would: the scene in all of the frame."""

LARGEST = 256 * 1024 * 1024
"""Bytes of one message; a scene's first one holds all its point clouds."""

WAITING = 4
"""Messages of Viser that may wait for a slow browser; Viser holds its own back then, and drops what is outdated."""


class ViserProxy:
    """Speaks to one Viser server on a loopback port."""

    def __init__(self, port: int, secret: str) -> None:
        self._port = port
        self._secret = secret

    async def http(self, request: Request) -> Response:
        """Fetch a file of Viser's client."""
        path = "/" + quote(request.path_params["path"])
        # Its page as it is, neither compressed nor from before, as something goes into it.
        asked = {} if path == "/" else dict(request.headers)
        try:
            status, headers, body = await asyncio.to_thread(self._fetch, path, asked)
        except (OSError, http.client.HTTPException) as error:
            return PlainTextResponse(f"Nisus: the Viser pane does not answer ({error}).\n", 502)
        if path == "/":
            ahead = AHEAD.format(script=SCRIPT.read_text())
            ahead += SCENE_ALONE if "scene" in request.query_params else ""
            body = body.replace(HEAD, HEAD + ahead.encode(), 1)
        answer = Response(body, status)
        for name, value in headers:
            if name.lower() in PASSED_ON and not (path == "/" and name.lower() == "etag"):
                answer.headers[name] = value
        return answer

    def _fetch(self, path: str, headers: dict[str, str]) -> tuple[int, list[tuple[str, str]], bytes]:
        wanted = {name: value for name, value in headers.items() if name in ASKED}
        connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=30.0)
        try:
            connection.request("GET", path, headers=wanted | {HEADER: self._secret})
            answer = connection.getresponse()
            return answer.status, answer.getheaders(), answer.read()
        finally:
            connection.close()

    async def websocket(self, browser: WebSocket) -> None:
        """Couple a browser's WebSocket with one of Viser's, until either closes."""
        # The pass has opened the gate; it is nobody else's business.
        query = urlencode([(name, value) for name, value in browser.query_params.multi_items() if name != "pass"])
        path = quote(browser.path_params.get("path", ""))
        url = f"ws://127.0.0.1:{self._port}/{path}" + (f"?{query}" if query else "")
        offered = [websockets.Subprotocol(name) for name in browser.scope.get("subprotocols", [])]
        try:
            viser = await connect(
                url, additional_headers={HEADER: self._secret}, subprotocols=offered or None, compression=None,
                max_size=LARGEST, max_queue=WAITING, ping_interval=None, proxy=None,
            )  # fmt: skip
        except (OSError, websockets.WebSocketException):
            await browser.close(1013)
            return
        async with viser:
            await browser.accept(subprotocol=viser.subprotocol)
            tasks = [asyncio.create_task(self._up(browser, viser)), asyncio.create_task(self._down(browser, viser))]
            try:
                await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)

    async def _up(self, browser: WebSocket, viser: ClientConnection) -> None:
        try:
            while True:
                message: Any = await browser.receive()
                if message["type"] == "websocket.disconnect":
                    return
                data = message.get("bytes")
                await viser.send(data if data is not None else message["text"])
        except websockets.ConnectionClosed:
            return

    async def _down(self, browser: WebSocket, viser: ClientConnection) -> None:
        try:
            async for message in viser:
                if isinstance(message, str):
                    await browser.send_text(message)
                else:
                    await browser.send_bytes(message)
            await browser.close(viser.close_code or 1000)
        except (WebSocketDisconnect, websockets.ConnectionClosed, RuntimeError):
            return
