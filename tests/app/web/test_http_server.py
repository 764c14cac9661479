"""The port of the page: access rules, served files, the Viser proxy and the streams."""

import asyncio
import json
import socket
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
import viser
from rerun.chunk import RrdReader
from websockets.sync.client import connect

from app.web.http_server import HttpServer, listen
from app.web.server import PageServer
from estimators.errors import ConfigError
from tests.app.scripted import pull_all, readings
from tests.app.served import SECRET
from tests.app.web.conftest import reviewing, serving
from tests.waiting import LIMIT_S, wait_for

STREAM = "/rerun/stream"


@pytest.fixture(scope="module")
def open_page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    with serving(folder) as serve:
        yield reviewing(serve, folder)


@pytest.fixture
def page(open_page):
    """One page for all requests, which leave it as it is."""
    open_page.viser.requests.clear()
    return open_page


@pytest.fixture
def fresh(serve, tmp_path):
    """A page of a test's own."""
    return reviewing(serve, tmp_path)


# Who is refused


def refused(answer, text=""):
    assert answer.status == 403
    assert answer.text.count("\n") == 1 and answer.text.endswith("\n")
    assert text in answer.text


@pytest.mark.parametrize(
    "hosts",
    [[], ["evil.example"], ["evil.example:{port}"], ["127.0.0.1.evil.example:{port}"], ["192.168.1.7:{port}"],
     ["127.0.0.1:{port}", "evil.example"]],
    ids=str,
)  # fmt: skip
@pytest.mark.parametrize("upgrade", [False, True])
def test_foreign_host_is_refused(page, hosts, upgrade):
    client = page.client
    headers = [("Host", host.format(port=client.port)) for host in hosts]
    headers += [("Cookie", client.cookie)]
    headers += [("Origin", f"http://{headers[0][1]}")] if hosts else []
    answer = client.raw("GET", STREAM if upgrade else "/", headers, upgrade=upgrade)
    # Without one Host, or with two, it is no HTTP request at all.
    assert answer.status in ((400, 403) if len(hosts) != 1 else (403,))
    assert not page.viser.requests


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "https://127.0.0.1:{port}", "http://127.0.0.1:1", "http://localhost:{port}", "null"],
)
@pytest.mark.parametrize(
    "method, path",
    [("GET", "/"), ("POST", "/api/command"), ("POST", "/api/scene"), ("GET", "/viser/"), ("WS", STREAM),
     ("WS", "/viser/")],
)  # fmt: skip
def test_foreign_origin_is_refused(page, origin, method, path):
    client = page.client
    headers = [("Host", client.host), ("Cookie", client.cookie), ("Origin", origin.format(port=client.port))]
    answer = client.raw("GET" if method == "WS" else method, path, headers, upgrade=method == "WS")
    refused(answer)
    assert not page.viser.requests


@pytest.mark.parametrize("path", [STREAM, "/viser/"])
def test_websocket_without_origin_or_token_is_refused(page, path):
    client = page.client
    refused(client.raw("GET", path, [("Host", client.host), ("Cookie", client.cookie)], upgrade=True))
    refused(client.raw("GET", path, [("Host", client.host), ("Origin", client.origin)], upgrade=True), "token")
    assert not page.viser.requests


@pytest.mark.parametrize(
    "path",
    ["/", "/explore", "/api/status", "/api/scene", "/api/track.csv", "/api/report.html", "/alarms", "/api/recordings",
     "/rec/reviewed.rrd", "/page/style.css", "/viser/", "/nothing"],
)  # fmt: skip
def test_no_token_no_answer(page, path):
    client = page.client
    refused(client.raw("GET", path, [("Host", client.host)]), "token")
    refused(client.raw("GET", path + "?token=" + "x" * 43, [("Host", client.host)]), "token")
    name = client.cookie.partition("=")[0]
    refused(client.raw("GET", path, [("Host", client.host), ("Cookie", f"{name}=" + "0" * 64)]), "token")
    assert not page.viser.requests


def test_token_is_exchanged_for_a_cookie(page):
    client = page.client
    answer = client.raw("GET", f"/?token={client.token}", [("Host", client.host)])
    assert answer.status == 303
    assert answer.headers["location"] == "./"  # below any path at which a proxy offers it
    marks = {part.strip() for part in answer.headers["set-cookie"].split(";")[1:]}
    assert {"HttpOnly", "SameSite=Strict", "Path=/"} <= marks
    assert client.token not in answer.text
    opened = client.get("/")
    assert opened.status == 200 and "<title>" in opened.text
    assert client.token not in opened.text


def test_localhost_is_the_same_page(page):
    client = page.client
    host = f"localhost:{client.port}"
    headers = [("Host", host), ("Origin", f"http://{host}"), ("Cookie", client.cookie)]
    assert client.raw("GET", "/", headers).status == 200


def test_a_port_in_use_is_one_line(page):
    with pytest.raises(ConfigError, match=f"port {page.server.port}.* in use.* --port"):
        PageServer(page.engine, port=page.server.port, viser_port=None, secret=SECRET)


def test_the_end_of_an_answer_does_not_wait_for_the_acknowledgement_of_its_begin():
    """Without TCP_NODELAY each answer on a kept connection takes 40 ms."""
    listeners, _ = listen(0)

    async def option():
        found = asyncio.get_running_loop().create_future()

        def connected(_, writer):
            found.set_result(writer.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
            writer.close()

        async with await asyncio.start_server(connected, sock=listeners[0]):
            _, writer = await asyncio.open_connection(*listeners[0].getsockname()[:2])
            writer.close()
            return await found

    assert asyncio.run(option())
    for listener in listeners:
        listener.close()


def test_it_listens_on_loopback_only(page):
    assert {listener.getsockname()[0] for listener in page.server.http_server.sockets} <= {"127.0.0.1", "::1"}


# The scene, framed under the other name of this machine, where the browser sends no cookie


def framed(page, path, given, *, upgrade=False, origin="http://localhost:{port}"):
    headers = [("Host", f"localhost:{page.client.port}"), ("Sec-Fetch-Site", "cross-site")]
    headers += [("Origin", origin.format(port=page.client.port))] if upgrade else []
    return page.client.raw("GET", path + (f"?pass={given}" if given is not None else ""), headers, upgrade=upgrade)


def test_a_pass_opens_the_stage_without_a_cookie(page):
    given = page.server.http_server.scene_pass
    assert framed(page, "/viser/", given).status == 200
    here = f"localhost:{page.client.port}"
    with connect(
        f"ws://{here}/viser/?pass={given}&theme=light", origin=f"http://{here}", subprotocols=["viser-test"], proxy=None
    ) as scene:
        scene.send("text")
        assert scene.recv(timeout=LIMIT_S) == "text"
    assert page.viser.requests and not any(given in str(request) for request in page.viser.requests)


@pytest.mark.parametrize("path", ["/", "/api/status", "/api/model", "/viser/assets", "/page/page.js", STREAM])
@pytest.mark.parametrize("upgrade", [False, True])
def test_a_pass_opens_nothing_else(page, path, upgrade):
    refused(framed(page, path, page.server.http_server.scene_pass, upgrade=upgrade))


@pytest.mark.parametrize("given", [None, "", "x", "é", "{cookie}", "{token}x"])
@pytest.mark.parametrize("upgrade", [False, True])
def test_without_its_pass_the_stage_is_closed(page, given, upgrade):
    given = given and given.format(cookie=page.client.cookie, token=page.client.token)
    refused(framed(page, "/viser/", given and quote(given), upgrade=upgrade))


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:{port}", "null"])
def test_a_pass_does_not_let_another_site_connect(page, origin):
    refused(framed(page, "/viser/", page.server.http_server.scene_pass, upgrade=True, origin=origin))


def test_where_localhost_may_be_another_program_the_stage_stays_here():
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    with socket.create_server(("::1", port), family=socket.AF_INET6):
        http_server = HttpServer(port)
    try:
        assert http_server.scene_pass is None
    finally:
        http_server.stop()


# What is served


@pytest.mark.parametrize(
    "target",
    ["/rec/private.rrd", "/rec/..%2fprivate.rrd", "/rec/../private.rrd", "/rec/%2e%2e/private.rrd", "/rec/", "/rec/.",
     "/page/../server.py", "/page/%2e%2e/server.py", "/page/..%5cserver.py", "/page//etc/passwd",
     "/page/__init__.py/..",     "/viewer/../../private.rrd", "/viewer/0.0.0/re_viewer.js"],
)  # fmt: skip
def test_nothing_else_of_the_disk_is_served(page, target):
    answer = page.client.get(target)
    assert answer.status in (400, 404, 405), answer.text
    assert "nobody's business" not in answer.text and "import" not in answer.text


def test_the_reviewed_recording_is_served(page):
    assert page.client.get("/rec/reviewed.rrd").body == b"RRF2 and so on"
    assert "reviewed.rrd" in page.get("/api/status")["recordings"]
    assert page.get("/api/recordings") == [{"name": "reviewed.rrd", "bytes": 14}]


def test_every_answer_forbids_to_leave_the_machine(page):
    for path in ("/", "/explore", "/api/status", "/page/style.css", "/viser/", "/nothing"):
        policy = page.client.get(path).headers["content-security-policy"]
        rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
        for name, sources in rules.items():
            allowed = {"'self'", "'none'", "data:", "blob:", "'unsafe-inline'", "'unsafe-eval'", "'wasm-unsafe-eval'"}
            allowed |= {f"ws://127.0.0.1:{page.server.port}", f"ws://localhost:{page.server.port}"}
            own = {f"http://127.0.0.1:{page.server.port}", f"http://localhost:{page.server.port}"}
            framing = own if name in ("frame-src", "frame-ancestors") else set()
            assert set(sources.split()) <= allowed | framing, name
        assert {"default-src", "connect-src", "script-src", "frame-ancestors"} <= rules.keys()


def test_a_command_is_noted_with_the_revision_that_its_user_saw(serve, monkeypatch):
    page = serve(20)
    submit = page.engine.submit
    # The answer takes longer than the refold: on a slow machine it may.
    monkeypatch.setattr(page.engine, "submit", lambda command: page.refolded(lambda: submit(command)))
    for value in (0.5, 0.25):
        assert page.command("SetTuning", key="Q.temperature", value=value) is None
    assert [(entry["body"]["value"], entry["revision"]) for entry in page.get("/api/audit")] == [(0.5, 0), (0.25, 1)]


# Viser behind it


def test_the_scene_is_chosen_and_the_status_tells_it(fresh):
    offered = fresh.get("/api/scene")
    assert offered == [{"key": "x", "label": "x", "options": ["temperature", "rate"], "value": "temperature"}]
    assert json.loads(fresh.client.post("/api/scene", {"key": "x", "value": "rate"}).text)[0]["value"] == "rate"
    assert fresh.choices.values() == {"x": "rate"}
    assert fresh.get("/api/status")["scene"][0]["value"] == "rate"
    for body in ({"key": "x", "value": "mass"}, {"key": "w", "value": "rate"}, {}, [], 7):
        answer = fresh.client.post("/api/scene", body)
        assert answer.status == 400 and answer.text.count("\n") == 0 and json.loads(answer.text)["error"]
    assert fresh.choices.values() == {"x": "rate"}


def test_the_page_of_rerun_is_without_the_rest(page):
    alone = page.client.get("/explore").text
    assert 'id="rerun"' in alone and 'id="tune"' not in alone and "{{settings}}" not in alone


def test_visers_client_is_its_own_file_with_a_script_and_a_style_of_ours_and_there_is_no_other(page):
    answer = page.client.get("/viser/")
    head, rest = Path(viser.__file__).with_name("client").joinpath("build/index.html").read_text().split("<head>", 1)
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    assert answer.text.startswith(f"{head}<head><script>") and answer.text.endswith(f"</style>{rest}")
    assert page.client.get("/viser/assets/a.js?v=1").status == 404 and not page.viser.requests


def test_viser_messages_pass_both_ways_and_no_secret_of_the_browser(page):
    client = page.client
    headers = {"Cookie": client.cookie, "X-Nisus-Secret": "guess"}
    with connect(
        f"ws://{client.host}/viser/?a=b", origin=client.origin, additional_headers=headers, subprotocols=["viser-test"],
        proxy=None,
    ) as scene:  # fmt: skip
        assert scene.subprotocol == "viser-test"
        for message in ("text", b"bytes"):
            scene.send(message)
            assert scene.recv(timeout=LIMIT_S) == message
    assert page.viser.requests == [("/?a=b", [SECRET])]


# The streams


def test_a_page_gets_the_next_frames_once_it_has_drawn_the_last_ones(fresh):
    def message(key):
        """The next message that has a key."""

        def received():
            text = stream.recv(timeout=LIMIT_S)
            if isinstance(text, str) and key in (found := json.loads(text)):
                return found
            assert isinstance(text, bytes) or "error" not in text
            return None

        return wait_for(received)[key]

    fresh.source.put(readings([1.0, 2.0], [40.0, 41.0]))
    wait_for(lambda: fresh.rows() == 2)
    with fresh.connect("/api/stream") as stream:
        stream.send(json.dumps({"streams": {"charts": {"columns": ["nis"]}}}))
        message("frames")
        fresh.source.put(readings([3.0], [40.0]))
        stream.send(json.dumps({"drawn": True}))
        message("frames")
        for wrong in ([], {"drwan": True}, {"streams": {"charts": {"columns": ["nis"], "of": 1}}}, {"pair": ["a"]}):
            stream.send(json.dumps(wrong))
            assert message("error").startswith("page: ")


# The feed of the Rerun viewer


class Viewer:
    """Browser that reads the times of each path, and answers that it has drawn them."""

    def __init__(self, connection, tmp_path):
        self.connection, self.file = connection, tmp_path / "piece.rrd"
        self.newest = {}
        """By path, ns."""

    def take(self):
        message = self.connection.recv(timeout=LIMIT_S)
        if isinstance(message, bytes):
            self.file.write_bytes(message)
            for chunk in RrdReader(str(self.file)).stream():
                columns = (batch := chunk.to_record_batch()).schema.names
                if not chunk.is_static and "Scalars:scalars" in columns:
                    self.newest[chunk.entity_path] = batch.column(columns.index("time")).cast("int64").to_numpy().max()
            self.connection.send("drawn")

    def until(self, condition):
        wait_for(lambda: condition() or self.take())


def test_a_viewer_that_stops_reading_costs_nobody_anything(fresh, tmp_path):
    state = f"/state/{fresh.engine.model.state_names[0]}"
    with fresh.connect(STREAM) as stuck, fresh.connect(STREAM) as connection:
        viewer = Viewer(connection, tmp_path)
        sent = 0
        for _ in range(20):
            batch = readings((sent + np.arange(1, 2001)) * 0.001, 40 + np.zeros(2000))
            fresh.source.put(batch)
            sent += len(batch)
            viewer.until(lambda: viewer.newest.get(state) == batch.t[-1])  # noqa: B023
        assert len(pull_all(fresh.engine).events) == sent
        # The stuck one was given one picture, and asked for no other: there is no queue for it that grows.
        pictures = 0
        while True:
            try:
                pictures += isinstance(stuck.recv(timeout=0), bytes)
            except TimeoutError:
                break
        assert pictures <= 1


def test_a_viewer_that_leaves_is_forgotten(fresh, tmp_path):
    fresh.source.put(readings([1.0], [40.0]))
    wait_for(lambda: fresh.rows() == 1)
    with fresh.connect(STREAM) as connection:
        Viewer(connection, tmp_path).take()
        wait_for(lambda: len(fresh.engine._cursors) == 2)
    # What is left is the engine's own, of its episode log.
    wait_for(lambda: len(fresh.engine._cursors) == 1)
