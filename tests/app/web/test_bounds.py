"""How much the page server takes from anybody: connections, the time for a request, its size, and nonsense."""

import hashlib
import json
import math
import random
import socket
from contextlib import ExitStack
from pathlib import Path
from select import select
from urllib.parse import quote

import numpy as np
import pytest
from starlette.responses import PlainTextResponse
from websockets.exceptions import ConnectionClosed, InvalidStatus

from app.scene import guarded_server as private_viser
from app.web import http_server
from app.web.access import Grant
from app.web.http import MAX_BODY_BYTES as BODY
from app.web.http_server import MAX_CONNECTIONS as CONNECTIONS
from tests.app.scripted import Replayed, readings
from tests.app.web.test_http_server import STREAM
from tests.waiting import LIMIT_S, wait_for

HALF = b"GET /api/status HTTP/1.1\r\nHost: 127.0.0.1"


def half_open(port, sent=HALF):
    sock = socket.create_connection(("127.0.0.1", port), timeout=LIMIT_S)
    sock.sendall(sent)
    return sock


def is_open(sock):
    sock.setblocking(False)
    try:
        return sock.recv(1) != b""
    except BlockingIOError:
        return True
    except OSError:
        return False


# Connections, and the time for a request


def test_many_half_open_connections_leave_room_for_an_honest_one(page):
    with page.connect(STREAM) as stream:
        crowd = [half_open(page.client.port) for _ in range(3 * CONNECTIONS)]
        try:
            for _ in range(3):
                assert page.client.get("/api/status").status == 200
            # Who has been let in already stays.
            assert json.loads(stream.recv(timeout=LIMIT_S))
            wait_for(lambda: sum(map(is_open, crowd)) <= CONNECTIONS)
        finally:
            for sock in crowd:
                sock.close()


@pytest.mark.parametrize(
    "sent",
    [b"", HALF, b"POST /api/command HTTP/1.1\r\nContent-Length: 10\r\n",
     b"GET /viser/ HTTP/1.1\r\nUpgrade: websocket\r\n"],
)  # fmt: skip
def test_a_header_that_does_not_end_is_not_waited_for(page, monkeypatch, sent):
    monkeypatch.setattr(http_server, "REQUEST_TIMEOUT_S", 0.3)
    with half_open(page.client.port, sent) as sock:
        assert b"200 OK" not in sock.recv(65536)


def test_a_header_that_trickles_is_not_waited_for_either(page, monkeypatch):
    monkeypatch.setattr(http_server, "REQUEST_TIMEOUT_S", 0.3)
    client = page.client
    first = f"GET /api/status HTTP/1.1\r\nHost: {client.host}\r\nCookie: {client.cookie}\r\n\r\n".encode()
    with half_open(client.port, first) as sock:
        sock.settimeout(0.05)
        got = b""

        def ended():
            nonlocal got
            try:
                # The second request never ends, although each of its bytes comes in good time.
                sock.sendall(b"G" if not got.endswith(b"}") else b"GET / HTTP/1.1\r\nX: ")
                piece = sock.recv(65536)
            except TimeoutError:
                return False
            except OSError:
                return True
            got += piece
            return piece == b""

        wait_for(ended)


def test_a_body_that_does_not_end_is_not_waited_for(page, monkeypatch):
    client = page.client
    head = f"Host: {client.host}\r\nCookie: {client.cookie}\r\nOrigin: {client.origin}\r\n"
    kind = "Content-Type: application/json\r\nContent-Length: 40\r\n\r\n{"
    monkeypatch.setattr(http_server, "REQUEST_TIMEOUT_S", 0.3)
    with half_open(client.port, f"POST /api/command HTTP/1.1\r\n{head}{kind}".encode()) as sock:
        assert b"HTTP/1.1 202" not in sock.recv(65536)


def test_the_private_viser_server_is_not_crowded_out_either(monkeypatch, capfd):
    monkeypatch.setattr(private_viser, "MAX_CONNECTIONS", 8)
    server = private_viser.guarded_server("s3cret", "crowded")
    crowd = []
    try:
        crowd = [half_open(server.get_port()) for _ in range(40)]
        with half_open(server.get_port(), b"GET / HTTP/1.1\r\nX-Nisus-Secret: s3cret\r\n\r\n") as sock:
            assert sock.recv(15) == b"HTTP/1.1 200 OK"
        wait_for(lambda: sum(map(is_open, crowd)) <= 8)
    finally:
        for sock in crowd:
            sock.close()
        server.stop()
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("role, held", [("view", [24, 24, 16, 0]), ("tune", [24, 24, 24, 8]), ("admin", [88, 0, 0, 0])])
def test_streams_of_some_users_leave_room_for_the_owner_and_for_health(role, held):
    grants = [Grant(name, role, hashlib.sha256(name.encode()).hexdigest()) for name in "abcd"]
    served = http_server.HttpServer(0, grants)

    async def hold(scope, receive, send):
        while scope["path"] == "/stream" and (await receive())["type"] != "http.disconnect":
            pass
        await PlainTextResponse("here")(scope, receive, send)

    def ask(path, token):
        head = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {token}\r\n\r\n"
        return half_open(served.port, head.encode())

    served.show(hold)
    served.start()
    with ExitStack() as crowd:
        crowd.callback(served.stop)
        for name, expected in zip("abcd", held, strict=True):
            asked = [crowd.enter_context(ask("/stream", name)) for _ in range(CONNECTIONS)]
            wait_for(lambda: CONNECTIONS - len(select(asked, [], [], 0)[0]) == expected)  # noqa: B023
        with ask("/healthz", "") as health, ask("/api/state", served.token) as owner:
            assert health.recv(15) == b"HTTP/1.1 200 OK"
            assert owner.recv(12) == (b"HTTP/1.1 200" if role != "admin" else b"HTTP/1.1 503")


# Sizes


def test_a_body_of_more_than_64_kb_is_refused(page):
    padded = b'{"command": "Restore"' + b" " * BODY + b"}"
    answer = page.client.post("/api/command", padded)
    assert answer.status == 413 and "64 kB" in answer.text and answer.text.count("\n") == 1
    fits = b'{"command": "Restore"' + b" " * (BODY - 22) + b"}"
    assert len(fits) == BODY and page.client.post("/api/command", fits).status == 202


def test_a_body_of_unsaid_length_is_counted(page):
    client = page.client
    head = [("Host", client.host), ("Cookie", client.cookie), ("Origin", client.origin)]
    lines = ["POST /api/command HTTP/1.1", *(f"{name}: {value}" for name, value in head), "Connection: close"]
    lines += ["Content-Type: application/json", "Transfer-Encoding: chunked", "", ""]
    chunk = b"1000\r\n" + b" " * 4096 + b"\r\n"
    with half_open(client.port, "\r\n".join(lines).encode() + chunk * 17 + b"0\r\n\r\n") as sock:
        assert sock.recv(65536).startswith(b"HTTP/1.1 413")


def test_what_a_browser_says_on_the_stream_is_a_word(page):
    for message in ("x" * (BODY + 1), b"bytes"):
        with page.connect(STREAM) as stream, pytest.raises(ConnectionClosed):
            stream.send(message)
            wait_for(lambda: stream.recv(timeout=LIMIT_S) is None)
    # What is left is the engine's own, of its episode log.
    wait_for(lambda: len(page.engine._cursors) == 1)


def test_large_things_still_pass(page):
    recording = bytes(range(256)) * 2**15
    page.server._review.write_bytes(recording)
    assert page.client.get("/rec/reviewed.rrd").body == recording
    with page.connect("/viser/", subprotocols=["viser-test"]) as viser:
        upload = bytes(2**23)
        viser.send(upload)
        assert viser.recv(timeout=LIMIT_S) == upload


# Nonsense

NASTY = [
    None, True, False, 0, -1, 1, 0.5, -0.0, 1e300, -1e300, 1e-320, 10**30, -(10**400), 2**63, math.inf, -math.inf,
    math.nan, [], {}, [None], {"a": 1}, [[[[]]]],
    "", " ", "inf", "-inf", "nan", "\0", "a\0b.rrd", "\ud800", "\udfff.rrd", "\udcff.rrd", "x" * 300 + ".rrd",
    "é" * 200 + ".rrd", "x" * 5000, "a" * 60_000, ".rrd", "..rrd", "a/b.rrd", "a\\b.rrd", "line\nbreak.rrd",
    "tab\tbell\a.rrd", "con.rrd", "C:x.rrd", "Q.rate", "Q.", ".", "R.winding", "R.winding\0", "p.", "gate",
    "use.winding", "kf", "ekf\n", "ukf", "winding", "alpha", "robust",
]  # fmt: skip
COMMANDS = {
    "SetEstimator": ["name"], "SetTuning": ["key", "value"], "SetOption": ["name", "value"],
    "UseSensor": ["name", "used"], "Restore": [], "Reset": [], "Pause": ["paused"], "Speed": ["factor"], "Step": [],
    "Seek": ["seconds"], "Record": ["path"],
}  # fmt: skip
USUAL = {"name": ["ukf", "robust", "winding"], "key": ["Q.temperature", "R.winding", "gate"], "path": ["a.rrd"]}


def said(answer):
    return json.loads(answer.text)["error"] if answer.text.startswith("{") else answer.text.rstrip("\n")


def one_line(answer, asked):
    assert answer.status < 500, (asked, answer.text)
    if answer.status >= 400:
        line = said(answer)
        assert line and line.isprintable() and len(line) < 1000, (asked, line)


@pytest.fixture
def seekable(serve, tmp_path, monkeypatch):
    """The page over a source that can be sought, with a recorder that records nothing."""
    monkeypatch.chdir(tmp_path)
    page = serve(source=Replayed())
    recorder = {"record": lambda self, path: None, "path": None, "finished": [], "folder": Path()}
    page.engine.recorder = type("Deaf", (), recorder)()
    page.source.put(readings([1.0, 2.0], [40.0, 41.0]))
    wait_for(lambda: page.rows() == 2)
    yield page
    page.engine.recorder = None


def test_no_command_is_answered_by_a_failure_of_ours(seekable):
    draw = random.Random(9)
    asked = [{"command": value} for value in NASTY] + [value for value in NASTY]
    asked += [{**{"command": name}, "extra": value} for name in COMMANDS for value in NASTY[:3]]
    asked += [{"command": "Reset", key: 1} for key in NASTY if isinstance(key, str)]
    for name, fields in COMMANDS.items():
        for field in fields:
            for value in NASTY:
                for usual in USUAL.get(next((other for other in fields if other != field), ""), [1.0]):
                    asked.append({"command": name, **{other: usual for other in fields}, field: value})
        asked += [{"command": name, **{field: draw.choice(NASTY) for field in fields}} for _ in range(20)]
    for body in asked:
        one_line(seekable.client.post("/api/command", body), body)
    for _ in range(100):
        body = json.dumps(draw.choice(asked)).encode()
        at = draw.randrange(len(body) + 1)
        damaged = (
            body[:at] + draw.choice([b"", b"\xff", b"\0", b"\\ud800", b"\\", b"[" * 60_000, b"9" * 5000]) + body[at:]
        )
        one_line(seekable.client.post("/api/command", damaged), damaged)
    # Nor did any of it stop the twin, or spoil its state.
    before = seekable.rows()
    seekable.source.put(readings([3.0], [41.0]))
    wait_for(lambda: seekable.rows() == before + 1)
    assert seekable.get("/api/status")["counts"].get("engine error", 0) == 0


def test_no_address_is_answered_by_a_failure_of_ours(page):
    parts = [*(value for value in NASTY if isinstance(value, str)), "..", "%", "\r\nX-A: b", "é", "?", "#", "//", "*"]
    for root in ("/", "/api/", "/rec/", "/page/", "/viewer/", "/viewer/0.41.0/", "/viser/", "/rerun/"):
        for part in parts:
            target = root + quote(part[:5000].encode("utf-8", "surrogatepass"))
            answer = page.client.get(target)
            assert answer.status < 500, (target, answer.text)
    for method in ("POST", "PUT", "DELETE", "OPTIONS", "TRACE", "PATCH", "BREW"):
        for path in ("/", "/api/status", "/api/command", "/rec/reviewed.rrd", "/page/page.js", "/viser/", STREAM):
            head = [("Host", page.client.host), ("Cookie", page.client.cookie), ("Origin", page.client.origin)]
            assert page.client.raw(method, path, head).status < 500, (method, path)


@pytest.mark.parametrize(
    "name, value",
    [("Cookie", "nisus=é; \xff"), ("Cookie", "{name}=\xff"), ("Authorization", "Bearer \xff"),
     ("Accept-Encoding", "\xff")],
)  # fmt: skip
def test_no_header_is_answered_by_a_failure_of_ours(page, name, value):
    client = page.client
    value = value.format(name=client.cookie.partition("=")[0])
    for path in ("/", "/?token=%ff%fe", "/?token=\\ud800", "/api/status", "/viser/"):
        assert client.raw("GET", path, [("Host", client.host), (name, value)]).status < 500
    for path in ("/viser/é%00?q=%ff", "/viser/%0d%0a", STREAM + "?layout=%ff"):
        try:
            page.connect(quote(path, safe="/%?=")).close()
        except (InvalidStatus, ConnectionClosed) as error:
            assert not isinstance(error, InvalidStatus) or error.response.status_code < 500


def test_status_is_strict_json_and_counts_whatever_was_asked(seekable):
    seekable.source.put(readings([3.0], [np.nan]))
    for command in ({"command": "SetTuning", "key": "gate", "value": None}, {"command": "Speed", "factor": "inf"}):
        assert seekable.client.post("/api/command", command).status == 202
    text = seekable.client.get("/api/status").text
    status = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert (status["twin"], status["estimator"]) == ("scripted", "kf") and np.isfinite(status["t"])
    wait_for(lambda: seekable.get("/api/status")["counts"]["readings"] == 3)
    assert seekable.get("/api/status")["counts"]["missing"] == 1
