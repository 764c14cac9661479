"""Alerts to HTTP servers, and the end of a connection that takes too long."""

from __future__ import annotations

import hashlib
import hmac
import socket
import threading
import time
from contextlib import suppress
from functools import partial
from http.client import HTTPConnection, HTTPResponse, HTTPSConnection
from pathlib import Path
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import HTTPHandler, HTTPRedirectHandler, HTTPSHandler, Request, build_opener

from app.engine.outputs.alerts import AlertMessage
from app.engine.outputs.receivers import TIMEOUT_S
from app.twin.secrets import NO_SECRETS, Secrets

from .schema import WebhookSection


class KeptRequest(HTTPRedirectHandler):
    """Follows no redirect: a signed alert goes to the address that was configured, or nowhere."""

    def redirect_request(self, *args: object, **more: object) -> None:
        """Return no request."""


class Deadline:
    """Ends connections after `TIMEOUT_S`, also those on which bytes still arrive, one by one."""

    def __init__(self) -> None:
        self.sockets: list[socket.socket] = []
        self.passed = False
        self.timer = threading.Timer(TIMEOUT_S, self._end)
        self.timer.daemon = True
        self.timer.start()

    def _end(self) -> None:
        self.passed = True
        for sock in self.sockets:
            with suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)

    def missed(self, error: Exception) -> bool:
        """Return whether an error is that of the deadline, or of the timeout of a socket, which a handshake has too."""
        return self.passed or isinstance(getattr(error, "reason", error), TimeoutError)

    def end(self) -> None:
        """Stop the clock."""
        self.timer.cancel()
        for sock in self.sockets:
            sock.close()


class RequestDeadline(HTTPSHandler, HTTPHandler):
    """Connections of a request, which end at the deadline."""

    def __init__(self, deadline: Deadline) -> None:
        super().__init__()
        self._deadline = deadline

    def http_open(self, request: Request) -> HTTPResponse:
        """See `HTTPHandler`."""
        return self.do_open(partial(self._connection, PlainConnection), request)  # type: ignore[arg-type]

    def https_open(self, request: Request) -> HTTPResponse:
        """See `HTTPSHandler`."""
        return self.do_open(partial(self._connection, SecureConnection), request)  # type: ignore[arg-type]

    def _connection(self, kind: type[PlainConnection], *args: Any, **more: Any) -> PlainConnection:
        connection = kind(*args, **more)
        connection.sockets = self._deadline.sockets
        return connection


class PlainConnection(HTTPConnection):
    """Connection whose socket is added to a list as soon as it is connected."""

    sockets: list[socket.socket]

    def connect(self) -> None:
        """See `HTTPConnection`."""
        super().connect()
        self.sockets.append(self.sock.dup())  # TLS takes the first one over


class SecureConnection(HTTPSConnection, PlainConnection):
    """The same with TLS, whose handshake counts too."""


class Webhook:
    """Sends alerts by POST; the signature is that of the time, a dot, and the body."""

    def __init__(self, section: WebhookSection, _folder: Path, secrets: Secrets = NO_SECRETS) -> None:
        self._url = secrets[section.url[1:]] if section.url.startswith("$") else section.url
        self._key = None if section.secret_env is None else secrets[section.secret_env].encode()

    def send(self, alert: AlertMessage) -> None:
        """See `Receiver`."""
        body, stamp = alert.model_dump_json().encode(), str(int(time.time()))
        headers = {"Content-Type": "application/json", "User-Agent": "nisus", "X-Nisus-Timestamp": stamp}
        if self._key is not None:
            signature = hmac.new(self._key, stamp.encode() + b"." + body, hashlib.sha256).hexdigest()
            headers["X-Nisus-Signature"] = f"sha256={signature}"
        deadline = Deadline()
        try:
            build_opener(KeptRequest, RequestDeadline(deadline)).open(
                Request(self._url, body, headers), timeout=TIMEOUT_S
            ).close()
            if deadline.passed:  # http.client takes the end of the connection for that of the header
                raise TimeoutError
        except HTTPError as error:
            error.close()
            raise OSError(f"it answers {error.code}") from None
        except Exception as error:
            if deadline.missed(error):
                raise OSError(f"it has not answered within {TIMEOUT_S:g} s") from None
            if isinstance(error, URLError | ValueError):  # ValueError: an address that is none, from the environment
                raise OSError(str(getattr(error, "reason", error))) from None
            raise
        finally:
            deadline.end()
