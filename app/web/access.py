"""Access to the page server: for a browser on this machine, on the page itself, that has shown the token.

A web page anywhere can make the user's browser send requests to 127.0.0.1, and a name anywhere can be made to point
there. So every request, WebSocket upgrades included, is refused before any work unless its Host is a loopback name, its
Origin (if it has one) is this server, and it carries the token or the cookie that the token was exchanged for.

The scene is framed under the other loopback name of this machine, so that the browser draws it in a process of its own.
For the browser that is another site, to which it sends no cookie: a pass in the address opens the scene alone.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import os
import re
import stat
import threading
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

from starlette.datastructures import Headers, MutableHeaders, QueryParams
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from estimators.errors import ConfigError, nearest, shown_name

LOOPBACK_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?", re.IGNORECASE)

SITE = re.compile(r"(https?)://(?:[a-z0-9._-]+|\[[0-9a-f:]+\])(?::([1-9][0-9]{0,4}))?")
"""An origin as browsers name it; groups: scheme and port."""

PORTS = {"http": 80, "https": 443}
"""Ports that browsers leave out."""

SCENE_PATH = "/viser/"

NEEDS_TOKENS = "others can reach it; give --tokens FILE, which has a token for each user"
"""Rule of addresses other than this machine's."""

OPEN_PATHS = ("/healthz", "/readyz")
"""For supervisors of processes, which have no token: such a request has no `User`, and gets the status only."""

REFUSED_HOST = "Nisus: this Host is not served; open the page at 127.0.0.1.\n"
REFUSED_ORIGIN = "Nisus: requests from other sites are refused.\n"
REFUSED_TOKEN = "Nisus: open the page at the address, with its token, that `nisus run` printed.\n"

FORWARD = '<!doctype html><meta http-equiv="refresh" content="0;url=./"><title>Nisus</title>'

COMMON_HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
}


VIEW, FEED, TUNE, ADMIN = ROLES = ("view", "feed", "tune", "admin")
"""Roles of tokens in a file: to read, to send measurements, to read and change, and all."""

READINGS = "/api/readings"

MIN_TOKEN_CHARACTERS = 16

MAX_REQUESTS = {VIEW: 64, FEED: 64, TUNE: 80, ADMIN: 88}
"""Requests and streams of all users together with which one of a role is still taken: fewer than the connections of the
port, so that there is room for roles that change things, and for health. A page holds up to eight."""

MAX_REQUESTS_OF_USER = 24
"""Requests and streams of a user who is no admin."""


class Grant(NamedTuple):
    """A token of a file: the name of its user, its role, and the digest of the token."""

    name: str
    role: str
    digest: str

    def allows(self, needed: str) -> bool:
        """Return whether the role includes what a request needs."""
        return needed == self.role or self.role == ADMIN or (self.role == TUNE and needed == VIEW)


class User(NamedTuple):
    """Who sent a request: name and role of the token, and the address of the client."""

    name: str
    role: str
    address: str


USER = "nisus.user"
"""Key of the `User` in the scope of a request that was let through."""

SESSION = "session"
"""Name of a user who has the session's own token, such as that of the page."""


def grants_of(tokens: Path | None, public: str | None) -> tuple[Grant, ...]:
    """Return the tokens of a file, which a page with a public address needs.

    Raises:
        ConfigError: If there is none, the address is no site, or the file cannot be used.
    """
    if public is not None and tokens is None:
        raise ConfigError(f"--public {public}: {NEEDS_TOKENS}")
    if public is not None and not _is_site(public):
        rule = "must be like https://twins.example.com, in lower case, without a path or the default port"
        raise ConfigError(f"--public {public}: {rule}")
    return () if tokens is None else read_tokens(tokens)


def _is_site(text: str) -> bool:
    """Return whether browsers name an origin like this; every request from another one is refused."""
    found = SITE.fullmatch(text)
    return found is not None and int(found[2] or 1) < 2**16 and int(found[2] or 1) != PORTS[found[1]]


def read_tokens(path: Path) -> tuple[Grant, ...]:
    """Return the tokens of a file with a line NAME ROLE TOKEN for each; # begins a comment.

    Raises:
        ConfigError: If others can read the file, or a line is wrong.
    """
    try:
        with path.open(encoding="utf-8") as file:
            mode = os.fstat(file.fileno()).st_mode
            lines = file.read().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--tokens {path}: cannot be read ({error}); check the path") from None
    if os.name == "posix" and mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError(f"--tokens {path}: other users can read it; chmod 600 {path}")
    found: list[Grant] = []
    for number, line in enumerate(lines, 1):
        words, where = line.partition("#")[0].split(), f"{path}:{number}: "
        if not words:
            continue
        if len(words) != 3:
            raise ConfigError(f"{where}has {len(words)} words; it must be NAME ROLE TOKEN")
        name, role, token = words
        if role not in ROLES:
            raise ConfigError(f"{where}role {shown_name(role)} is not known; {nearest(role, ROLES)}")
        if len(token) < MIN_TOKEN_CHARACTERS:
            raise ConfigError(
                f"{where}the token of {name} has {len(token)} letters; give at least {MIN_TOKEN_CHARACTERS}, "
                "for example of `openssl rand -hex 24`"
            )
        if name in [grant.name for grant in found] or _digest(token) in [grant.digest for grant in found]:
            raise ConfigError(f"{where}{name} or its token is there twice; give each user one token")
        found.append(Grant(name, role, _digest(token)))
    return tuple(found)


def path_of_twin(path: str) -> str:
    """Return a path within the page of a twin, also of one among several: /api/state of /twins/NAME/api/state."""
    _, twins, _, inner = (*path.split("/", 3), "", "", "")[:4]
    return f"/{inner}" if twins == "twins" else path


def needed_role(scope: Scope) -> str:
    """Return the role that a request needs."""
    path = path_of_twin(scope["path"])
    if path == READINGS and scope.get("method") == "POST":
        return FEED
    if path.startswith(SCENE_PATH.rstrip("/")):
        return TUNE  # the scene has controls
    if scope["type"] == "websocket" or scope["method"] in ("GET", "HEAD"):
        return VIEW
    return ADMIN if scope["path"].startswith("/api/gallery/") else TUNE


QUESTIONS = ("/api/readings", "/api/forecast", "/api/scene", "/api/gallery/log", "/api/gallery/log/curves")
"""Paths of POST requests that change no settings; measurements have no entry each in the audit log."""


def changes(path: str) -> bool:
    """Return whether a POST request to a path belongs in the audit log."""
    return path not in QUESTIONS


class AccessControl:
    """Lets a request through to an application, or answers 403 with one line."""

    def __init__(
        self,
        app: ASGIApp,
        token: str,
        port: int,
        former: Collection[str] = (),
        grants: Sequence[Grant] = (),
        *,
        addresses: bool = False,
        public: str | None = None,
    ) -> None:
        """Prepare for an application.

        Args:
            app: The application.
            token: The session's own, which allows everything.
            port: That is served.
            former: `digest` of sessions before at this port, whose open pages may return and get the new cookie.
            grants: Tokens of other programs, and of users.
            addresses: Whether a Host may be any IP address, which no other site's name can stand for.
            public: Address, https://HOST, at which a reverse proxy offers the page.
        """
        self._app, self._token, self._former = app, token, frozenset(former)
        self._grants = tuple(grants)
        self._addresses, self._public = addresses, public
        self._open = Counter[str]()
        self._name = f"nisus_{port}"
        self.entered = threading.Event()
        """Set once a browser has shown the token."""
        # The cookie is not the token, so that it does not reveal the address.
        self._cookie = f"nisus_{port}={self._derived(f'cookie {port}')}"
        self.digest = _digest(self._cookie)
        """Digest of the cookie, by which a later session recognises it."""
        self.scene_pass = self._derived(f"stage {port}")
        """Pass in the address of the scene, which the page frames."""

    def _derived(self, purpose: str) -> str:
        return hmac.new(self._token.encode(), purpose.encode(), hashlib.sha256).hexdigest()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request (ASGI)."""
        response = self._response(scope)
        counted = response is None and scope["path"] not in OPEN_PATHS
        if counted:
            response = self._crowded(scope[USER])
        if response is not None or not counted:
            await (response or self._app)(scope, receive, send)
            return
        returns = scope["type"] == "http" and self._is_former(Headers(scope=scope))
        self._open[scope[USER].name] += 1
        try:
            await self._app(scope, receive, self._with_cookie(send) if returns else send)
        finally:
            self._open[scope[USER].name] -= 1

    def _crowded(self, user: User) -> ASGIApp | None:
        """Return the answer to a request of a user who has too many, or while there are too many."""
        mine, all_open = self._open[user.name], self._open.total()
        if mine >= MAX_REQUESTS_OF_USER and user.role != ADMIN:
            return _refusal(f"Nisus: {user.name} has {mine} requests and streams open; close some pages.\n", 429)
        if all_open >= MAX_REQUESTS.get(user.role, MAX_REQUESTS[VIEW]):
            return _refusal(f"Nisus: {all_open} requests and streams are open; try again later.\n", 503)
        return None

    def _response(self, scope: Scope) -> ASGIApp | None:
        """Return the answer to a request that does not pass."""
        headers, query = Headers(scope=scope), QueryParams(scope["query_string"])
        host = _single(headers, "host") or ""
        published = self._public is not None and host == self._public.partition("://")[2]
        if not (LOOPBACK_HOST.fullmatch(host) or published or (self._addresses and _is_address(host))):
            return _refusal(REFUSED_HOST)
        shows_token = _equals(query.getlist("token"), self._token)
        framed = scope["path"] == SCENE_PATH and _equals(query.getlist("pass"), self.scene_pass)
        exchange = shows_token and scope["type"] == "http" and scope["path"] == "/" and scope["method"] == "GET"
        # Browsers name the origin of every WebSocket, and the site of a request without one.
        same_site = (_single(headers, "sec-fetch-site") or "none") in ("none", "same-origin")
        origins = headers.getlist("origin")
        if origins or scope["type"] == "websocket":
            from_here = origins == ([self._public] if published else [f"http://{host}"])
        else:
            from_here = same_site or exchange or framed
        if not from_here:
            return _refusal(REFUSED_ORIGIN)
        if exchange:
            return self._exchange(same_site, _marked(self._cookie, secure=self._secure(published)))
        if scope["type"] == "http" and scope["path"] == "/" and scope["method"] == "GET":
            for grant in self._granted(*query.getlist("token")[:1]):
                return self._exchange(same_site, _marked(self._cookie_of(grant), secure=self._secure(published)))
        if shows_token or framed or self._is_known(headers) or self._is_former(headers):
            passed_on = (_single(headers, "nisus-user") or "").split(" ")
            scope[USER] = User(*passed_on) if len(passed_on) == 3 else User(SESSION, ADMIN, self._address(scope))
            return None
        refused = self._refused(scope, headers)
        return None if scope["path"] in OPEN_PATHS else refused

    def _refused(self, scope: Scope, headers: Headers) -> ASGIApp | None:
        """Return the answer to a request without the session's token; None if one of a file allows it."""
        held = self._granted(_bearer(headers))
        if not held and self._grants:
            cookies = _cookies(headers)
            held = [grant for grant in self._grants if self._cookie_of(grant) in cookies]
        if not held:
            return _refusal(REFUSED_TOKEN)
        needed = needed_role(scope)
        if path_of_twin(scope["path"]) == READINGS and scope.get("method") == "GET" and held[0].allows(FEED):
            needed = FEED  # the names of the values, which a sender asks for
        if held[0].allows(needed):
            scope[USER] = User(held[0].name, held[0].role, self._address(scope))
            return None
        return _refusal(f"Nisus: the token of {held[0].name} has the role {held[0].role}; this needs {needed}.\n")

    def _address(self, scope: Scope) -> str:
        """Return the address of the client; behind a reverse proxy, the last one that it names."""
        named = Headers(scope=scope).getlist("x-forwarded-for") if self._public is not None else []
        client = scope.get("client")
        last = named[-1].rpartition(",")[2].split() if named else []
        return last[0] if len(last) == 1 else client[0] if client else "unknown"

    def _secure(self, published: bool) -> bool:
        """Return whether a request came through TLS."""
        return published and (self._public or "").startswith("https:")

    def _granted(self, token: str = "") -> list[Grant]:
        """Return the grant of a token, if there is one."""
        shown = hashlib.sha256(token.encode()).hexdigest()
        return [grant for grant in self._grants if hmac.compare_digest(grant.digest, shown)]

    def _cookie_of(self, grant: Grant) -> str:
        """Return the cookie for which a user's token is exchanged; it lasts as long as the token is in the file."""
        value = hmac.new(grant.digest.encode(), self._name.encode(), hashlib.sha256).hexdigest()
        return f"{self._name}_user={value}"

    def _is_known(self, headers: Headers) -> bool:
        """Return whether a request has the cookie, or the token as a header."""
        if _equals([_bearer(headers)], self._token):
            return True
        return any(_equals([cookie], self._cookie) for cookie in _cookies(headers))

    def _is_former(self, headers: Headers) -> bool:
        """Return whether a request has the cookie of a session before, and not yet that of this one."""
        digests = {_digest(cookie) for cookie in _cookies(headers)} if self._former else set()
        return bool(digests & self._former) and self.digest not in digests

    def _with_cookie(self, send: Send) -> Send:
        """Return `send` with the cookie of this session in the answer."""

        async def send_more(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).append("set-cookie", _marked(self._cookie))
            await send(message)

        return send_more

    def _exchange(self, same_site: bool, cookie: str) -> ASGIApp:
        """Move the token from the address into a cookie."""
        self.entered.set()
        headers = {
            "set-cookie": cookie,
            "cache-control": "no-store",
            "referrer-policy": "no-referrer",
        }
        # After a link on another page, the strict cookie would not be sent along a redirect.
        # Relative: a reverse proxy may offer the page below a path.
        return RedirectResponse("./", 303, headers) if same_site else HTMLResponse(FORWARD, headers=headers)


def _marked(cookie: str, *, secure: bool = False) -> str:
    return f"{cookie}; Path=/; HttpOnly; SameSite=Strict{'; Secure' if secure else ''}"


def _is_address(host: str) -> bool:
    """Return whether a Host is an IP address, with or without a port."""
    name = host.rpartition(":")[0] if host.count(":") == 1 or "]:" in host else host
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


def _bearer(headers: Headers) -> str:
    """Return the token of the header, empty without one."""
    kind, _, token = (_single(headers, "authorization") or "").partition(" ")
    return token.strip() if kind.lower() == "bearer" else ""


def _cookies(headers: Headers) -> list[str]:
    # Other programs at 127.0.0.1 may have set a cookie of the same name.
    return [part.strip() for line in headers.getlist("cookie") for part in line.split(";")]


def _digest(cookie: str) -> str:
    return hashlib.sha256(cookie.encode()).hexdigest()


def _equals(given: list[str], secret: str) -> bool:
    return len(given) == 1 and hmac.compare_digest(given[0].encode(), secret.encode())


def _single(headers: Headers, name: str) -> str | None:
    """Return a header's value; None if it is absent or given twice, which no honest client does."""
    values = headers.getlist(name)
    return values[0] if len(values) == 1 else None


def _refusal(line: str, status: int = 403) -> ASGIApp:
    return PlainTextResponse(line, status, {"connection": "close"})


def with_security_headers(app: ASGIApp, port: int, public: str | None = None) -> ASGIApp:
    """Return an application whose answers forbid the browser to load anything from elsewhere."""
    # Viser's client is one file of inline scripts that unpack themselves.
    viser = _policy(port, "'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob: data:", public)
    own = _policy(port, "'wasm-unsafe-eval'", public)

    async def serve(scope: Scope, receive: Receive, send: Send) -> None:
        policy = viser if path_of_twin(scope["path"]).startswith("/viser") else own

        async def send_more(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update({**COMMON_HEADERS, "content-security-policy": policy})
                headers.setdefault("cache-control", "no-cache")
            await send(message)

        await app(scope, receive, send_more)

    return serve


def _policy(port: int, scripts: str, public: str | None) -> str:
    """Return a content security policy under which no request leaves this server."""
    # Not every browser takes 'self' to include the WebSockets of the same address.
    names = (f"127.0.0.1:{port}", f"localhost:{port}")
    sockets, here = (" ".join(f"{scheme}://{name}" for name in names) for scheme in ("ws", "http"))
    if public is not None:
        sockets, here = f"{sockets} {public.replace('http', 'ws', 1)}", f"{here} {public}"
    return (
        f"default-src 'self'; script-src 'self' {scripts}; style-src 'self' 'unsafe-inline'; "
        f"img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' data: blob: {sockets}; "
        f"worker-src 'self' blob: data:; frame-src 'self' {here}; frame-ancestors 'self' {here}; object-src 'none'; "
        "base-uri 'none'; form-action 'self'"
    )
