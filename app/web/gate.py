"""Access to the page server: for a browser on this machine, on the page itself, that has shown the token.

A web page anywhere can make the user's browser send requests to 127.0.0.1, and a name anywhere can be made to point
there. So every request, WebSocket upgrades included, is refused before any work unless its Host is a loopback name, its
Origin (if it has one) is this server, and it carries the token or the cookie that the token was exchanged for.

The stage is framed under this machine's other loopback name, so that the browser draws it in a process of its own. For
the browser that is another site, to which it sends no cookie: there a pass in the address lets in, to the stage alone.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import threading
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any
from urllib.parse import parse_qs

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?", re.IGNORECASE)

STAGE = "/viser/"

REFUSED_HOST = "Nisus: this Host is not served; open the page at 127.0.0.1.\n"
REFUSED_ORIGIN = "Nisus: requests from other sites are refused.\n"
REFUSED_TOKEN = "Nisus: open the page at the address, with its token, that `nisus run` printed.\n"


def session_token() -> str:
    """Return a token for one session; the next one has another."""
    return secrets.token_urlsafe(32)


class Gate:
    """Lets a request through to `app`, or answers 403 with one line."""

    def __init__(self, app: App, token: str, port: int) -> None:
        self._app = app
        self._token = token.encode()
        self.entered = threading.Event()
        """Set once a browser has shown the token."""
        self._cookie_name = f"nisus_{port}"
        # The cookie is not the token, so that it does not reveal the address.
        self._cookie = self._derived(f"cookie {port}")
        self._pass = self._derived(f"stage {port}")

    @property
    def stage_pass(self) -> str:
        """Pass in the address of the stage, which the page frames."""
        return self._pass.decode()

    def _derived(self, purpose: str) -> bytes:
        return hmac.new(self._token, purpose.encode(), hashlib.sha256).hexdigest().encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request (ASGI)."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = _Headers(scope["headers"])
        host = headers.one("host")
        if host is None or not _HOST.fullmatch(host):
            await _refuse(scope, receive, send, REFUSED_HOST)
            return
        query = parse_qs(scope["query_string"].decode("latin-1"))
        shows_token = _shows(query.get("token", []), self._token)
        framed = scope["path"] == STAGE and _shows(query.get("pass", []), self._pass)
        exchange = shows_token and scope["type"] == "http" and scope["path"] == "/" and scope["method"] == "GET"
        if not self._from_here(headers, host, scope["type"] == "websocket", exchange or framed):
            await _refuse(scope, receive, send, REFUSED_ORIGIN)
        elif exchange:
            await self._exchange(headers, send)
        elif shows_token or framed or self._has_cookie(headers) or self._has_bearer(headers):
            await self._app(scope, receive, send)
        else:
            await _refuse(scope, receive, send, REFUSED_TOKEN)

    def _from_here(self, headers: _Headers, host: str, upgrade: bool, shown: bool) -> bool:
        origins = headers.all("origin")
        if origins or upgrade:
            # A browser always names the origin of a WebSocket.
            return origins == [f"http://{host}"]
        # Without Origin: a navigation, a request of the page itself, or no browser. Browsers say which it is.
        site = headers.one("sec-fetch-site") or "none"
        return shown or site in ("none", "same-origin")

    def _has_cookie(self, headers: _Headers) -> bool:
        for line in headers.all("cookie"):
            for part in line.split(";"):
                name, _, value = part.strip().partition("=")
                if name == self._cookie_name and hmac.compare_digest(value.encode(), self._cookie):
                    return True
        return False

    def _has_bearer(self, headers: _Headers) -> bool:
        kind, _, value = (headers.one("authorization") or "").partition(" ")
        return kind.lower() == "bearer" and hmac.compare_digest(value.strip().encode(), self._token)

    async def _exchange(self, headers: _Headers, send: Send) -> None:
        """Move the token from the address into a cookie."""
        self.entered.set()
        cookie = f"{self._cookie_name}={self._cookie.decode()}; Path=/; HttpOnly; SameSite=Strict"
        common = [
            (b"set-cookie", cookie.encode()), (b"cache-control", b"no-store"), (b"referrer-policy", b"no-referrer"),
        ]  # fmt: skip
        if (headers.one("sec-fetch-site") or "none") in ("none", "same-origin"):
            start = {"type": "http.response.start", "status": 303, "headers": [*common, (b"location", b"/")]}
            body = b""
        else:
            # A link on another page brought us here: a redirect would be its doing too, without the strict cookie.
            kind = (b"content-type", b"text/html")
            start = {"type": "http.response.start", "status": 200, "headers": [*common, kind]}
            body = b'<!doctype html><meta http-equiv="refresh" content="0;url=/"><title>Nisus</title>'
        await send(start)
        await send({"type": "http.response.body", "body": body})


def _shows(given: list[str], secret: bytes) -> bool:
    return len(given) == 1 and hmac.compare_digest(given[0].encode(), secret)


class _Headers:
    def __init__(self, raw: Any) -> None:
        self._raw = raw

    def all(self, name: str) -> list[str]:
        key = name.encode()
        return [value.decode("latin-1") for found, value in self._raw if found == key]

    def one(self, name: str) -> str | None:
        """The header's value; None if it is absent or given twice, which no honest client does."""
        values = self.all(name)
        return values[0] if len(values) == 1 else None


async def _refuse(scope: Scope, receive: Receive, send: Send, line: str) -> None:
    prefix = "http.response" if scope["type"] == "http" else "websocket.http.response"
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"connection", b"close")]
    if scope["type"] == "websocket":
        await receive()
    await send({"type": f"{prefix}.start", "status": 403, "headers": headers})
    await send({"type": f"{prefix}.body", "body": line.encode()})
