"""A page server over a scripted engine and a stand-in for Viser, and a client that sends exactly what it is told."""

import http.client
import io
import json
import socket
import threading
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.sync.client import connect
from websockets.sync.server import serve

from app.engine.engine import Engine
from app.scene.guarded_server import HEADER
from app.scene.renderer import Choice, Choices
from app.twin.versions import VERDICT_FILE
from app.web.server import PageServer
from config.tunings import folders
from tests.app.scripted import Scripted
from tests.app.scripted import twin as scripted_twin
from tests.waiting import LIMIT_S, wait_for

SECRET = "the secret between the servers"

VERDICT = {
    "recording": "winding",
    "at": "2026-11-22T10:30:00Z",
    "version": "own",
    "figures": 1,
    "worse": ["rmse.temperature was 0.5 and is 0.6: worse by 0.1, allowed 0.01"],
    "better": [],
    "failure": "",
}


def keep_verdicts(twin: Path, *verdicts: dict[str, Any]) -> None:
    """Write verdicts beside the versions of a twin, as `nisus guard` does."""
    path = folders(twin)[0] / VERDICT_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"recordings": verdicts}))


class FakeViser:
    """Echoes what comes over a WebSocket."""

    def __init__(self):
        self.requests = []
        self.server = serve(
            self.echo, "127.0.0.1", 0, process_request=self.process, subprotocols=["viser-test"], max_size=None
        )
        self.port = self.server.socket.getsockname()[1]
        self.thread = threading.Thread(target=self.server.serve_forever, daemon=True)
        self.thread.start()

    def process(self, connection, request):
        self.requests.append((request.path, request.headers.get_all(HEADER)))

    def echo(self, connection):
        for message in connection:
            connection.send(message)

    def stop(self):
        self.server.shutdown()
        self.thread.join()


class _Received:
    """What `http.client` reads an answer from, in place of a socket."""

    def __init__(self, data):
        self.data = data

    def makefile(self, mode):
        return io.BytesIO(self.data)


class Answer:
    """Status, headers and body of one answer."""

    def __init__(self, data):
        answer = http.client.HTTPResponse(_Received(data))
        answer.begin()
        self.status = answer.status
        self.headers = {name.lower(): value for name, value in answer.getheaders()}
        self.body = b"" if self.status == 101 else answer.read()

    @property
    def text(self):
        return self.body.decode()


class Client:
    """Sends requests with the headers given, none of its own."""

    def __init__(self, server):
        self.port = server.port
        self.host = f"127.0.0.1:{server.port}"
        self.origin = f"http://{self.host}"
        self.token = parse_qs(urlsplit(server.url).query)["token"][0]
        self._cookie = None

    @property
    def cookie(self):
        if self._cookie is None:
            answer = self.raw("GET", f"/?token={self.token}", [("Host", self.host)])
            self._cookie = answer.headers["set-cookie"].partition(";")[0]
        return self._cookie

    def raw(self, method, target, headers, body=b"", upgrade=False):
        lines = [f"{method} {target} HTTP/1.1", *(f"{name}: {value}" for name, value in headers)]
        if upgrade:
            lines += ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
            lines += ["Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="]
        else:
            lines += ["Connection: close"]
        if body:
            lines += [f"Content-Length: {len(body)}"]
        with socket.create_connection(("127.0.0.1", self.port), timeout=LIMIT_S) as sock:
            sock.sendall(("\r\n".join(lines) + "\r\n\r\n").encode("latin-1") + body)
            data = b""
            while piece := sock.recv(65536):
                data += piece
                if upgrade and b"\r\n\r\n" in data and data.startswith(b"HTTP/1.1 101"):
                    break
        return Answer(data)

    def get(self, target, **more):
        return self.raw("GET", target, [("Host", self.host), ("Cookie", self.cookie)], **more)

    def post(self, target, body):
        kind = ("Content-Type", "application/json")
        headers = [("Host", self.host), ("Cookie", self.cookie), ("Origin", self.origin), kind]
        return self.raw("POST", target, headers, json.dumps(body).encode() if not isinstance(body, bytes) else body)


class ServedEngine:
    """A scripted engine behind the page's port, with a stand-in for Viser; fields of answers are JSON."""

    def __init__(self, twin=None, review=None, behind=lambda source: source, source=None):
        self.source = source or Scripted()
        self.engine = Engine(scripted_twin() if twin is None else twin, lambda report: behind(self.source))
        self.viser = FakeViser()
        self.choices = Choices([Choice("x", "x", ("temperature", "rate"), "temperature")])
        self.server = PageServer(
            self.engine, port=0, viser_port=self.viser.port, secret=SECRET, review=review, choices=self.choices
        )
        self.server.start()
        self.engine.start()
        self.client = Client(self.server)

    def stop(self):
        self.engine.stop()
        self.server.stop()
        self.viser.stop()

    def connect(self, path, **options):
        headers = {"Cookie": self.client.cookie}
        return connect(
            f"ws://{self.client.host}{path}", origin=self.client.origin, additional_headers=headers,
            compression=None, max_size=None, proxy=None, open_timeout=LIMIT_S, close_timeout=0.5,
            ping_interval=None, **options,
        )  # fmt: skip

    def rows(self):
        return self.engine.status().counts["readings"]

    def get(self, path):
        return json.loads(self.client.get(path).text)

    def post(self, path, **fields):
        answer = self.client.post(path, fields)
        return answer.status, json.loads(answer.text)

    def refolded(self, act):
        """Do something that folds the history again, and wait for the end of that."""
        before = self.engine.status().revision
        result = act()
        wait_for(lambda: self.engine.status().revision > before and not self.engine.status().refolding)
        return result

    def command(self, command, **fields):
        """The reason if a command was refused, else None once it is carried out."""
        before = self.engine.revisions.version
        status, answer = self.post("/api/command", command=command, **fields)
        if status != 202:
            return answer["error"]
        wait_for(lambda: self.engine.revisions.version > before)
        return None
