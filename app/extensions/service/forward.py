"""Requests that a service passes on to the process of a twin."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from contextlib import suppress
from urllib.parse import quote

import h11
from starlette.responses import PlainTextResponse, Response
from starlette.types import Receive, Scope, Send

from app.web.access import USER, User

from .supervisor import ServedTwin

PIECE_BYTES = 65_536

HOP_HEADERS = (
    b"connection", b"keep-alive", b"transfer-encoding", b"upgrade", b"set-cookie", b"content-security-policy", b"date"
)  # fmt: skip
"""Headers of answers that are not passed on."""

REQUEST_HEADERS = (
    b"accept", b"accept-encoding", b"content-type", b"content-length", b"if-none-match", b"if-range", b"range",
    b"last-event-id",
)  # fmt: skip
"""Headers of requests that are passed on; the service has judged host, origin and token."""


def credentials(twin: ServedTwin, scope: Scope) -> Iterable[tuple[bytes, bytes]]:
    """Return the headers by which a twin's process accepts a request, with its user."""
    user = scope.get(USER) or User("", "", "")
    return (
        (b"authorization", f"Bearer {twin.token}".encode()),
        (b"nisus-user", " ".join(user).encode("utf-8", "replace")),
    )


class Forwarded(Response):
    """Answer of a twin's process, piece by piece."""

    def __init__(self, twin: ServedTwin, path: str) -> None:
        self._twin, self._path = twin, path
        self.background = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and the answer back, until either side ends."""
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", self._twin.port)
        except OSError:
            await PlainTextResponse(f"Nisus: {self._twin.name} does not answer.\n", 502)(scope, receive, send)
            return
        connection = h11.Connection(h11.CLIENT)
        sender = asyncio.ensure_future(self._send(connection, scope, receive, writer))
        answer = asyncio.ensure_future(self._answer(connection, reader, send))
        try:
            await asyncio.wait({sender, answer}, return_when=asyncio.FIRST_COMPLETED)
            if sender.done() and sender.result():
                answer.cancel()  # the client has gone
            if not await answer:
                refusal = PlainTextResponse(f"Nisus: {self._twin.name} ended before its answer.\n", 502)
                await refusal(scope, receive, send)
        except asyncio.CancelledError:
            pass
        finally:
            sender.cancel()
            answer.cancel()
            writer.close()

    async def _send(
        self, connection: h11.Connection, scope: Scope, receive: Receive, writer: asyncio.StreamWriter
    ) -> bool:
        """Send the request; return True once the client has gone."""
        target = quote(self._path).encode()
        query = scope["query_string"]
        headers = [(name, value) for name, value in scope["headers"] if name in REQUEST_HEADERS]
        if any(name == b"transfer-encoding" for name, _ in scope["headers"]):  # a body of unknown length
            headers = [item for item in headers if item[0] != b"content-length"]
            headers += [(b"transfer-encoding", b"chunked")]
        headers += [*credentials(self._twin, scope), (b"host", f"127.0.0.1:{self._twin.port}".encode())]
        headers += [(b"connection", b"close")]
        request = h11.Request(method=scope["method"], target=target + (b"?" + query if query else b""), headers=headers)
        with suppress(OSError, h11.LocalProtocolError):
            writer.write(connection.send(request) or b"")
            while (message := await receive())["type"] == "http.request":
                if message.get("body"):
                    writer.write(connection.send(h11.Data(message["body"])) or b"")
                    await writer.drain()
                if not message.get("more_body"):
                    writer.write(connection.send(h11.EndOfMessage()) or b"")
                    break
        while (await receive())["type"] != "http.disconnect":
            pass
        return True

    async def _answer(self, connection: h11.Connection, reader: asyncio.StreamReader, send: Send) -> bool:
        """Pass the answer back; return whether there was one."""
        begun = False
        # Relative, as the service may be behind a proxy at any path.
        origin, root = f"http://127.0.0.1:{self._twin.port}/".encode(), b"./" + b"../" * (self._path.count("/") - 1)
        with suppress(OSError, h11.RemoteProtocolError):
            while True:
                event = connection.next_event()
                if event is h11.NEED_DATA:
                    connection.receive_data(await reader.read(PIECE_BYTES))
                elif isinstance(event, h11.Response):
                    headers = [
                        (name, value.replace(origin, root, 1) if name == b"location" else value)
                        for name, value in event.headers
                        if name not in HOP_HEADERS
                    ]
                    await send({"type": "http.response.start", "status": event.status_code, "headers": headers})
                    begun = True
                elif isinstance(event, h11.Data):
                    await send({"type": "http.response.body", "body": bytes(event.data), "more_body": True})
                elif isinstance(event, h11.EndOfMessage):
                    await send({"type": "http.response.body", "body": b"", "more_body": False})
                    return True
                elif isinstance(event, h11.ConnectionClosed):
                    return begun
        return begun
