"""Token and cookie, the browser's own headers, and the files of the Rerun viewer."""

import asyncio
import gzip
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from app.engine.engine import Engine
from app.web import viewer_assets as assets_module
from app.web.access import USER, AccessControl, read_tokens
from app.web.server import PageServer
from app.web.viewer_assets import FILES, viewer_assets, viewer_version
from estimators.errors import ConfigError
from tests import ROOT
from tests.app.scripted import Scripted, twin
from tests.app.served import SECRET, Client
from tests.cases import cases
from tests.support import error_of
from tests.waiting import wait_for


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "nisus"


def served(monkeypatch, prepare):
    monkeypatch.setattr("app.web.server.viewer_assets", prepare)
    engine = Engine(twin(), lambda report: Scripted())
    server = PageServer(engine, port=0, viser_port=None, secret=SECRET)
    server.start()
    return server


def test_each_session_has_a_token_of_its_own(cache):
    engine = Engine(twin(), lambda report: Scripted())
    tokens = {PageServer(engine, port=0, viser_port=None, secret=SECRET).url.partition("token=")[2] for _ in range(3)}
    assert len(tokens) == 3 and all(len(token) >= 32 for token in tokens)
    # Nothing of it stays: what the last session's browsers know opens nothing.
    assert not cache.exists()


def test_a_session_keeps_its_token_and_its_cookie(monkeypatch, tmp_path):
    server = served(monkeypatch, lambda progress: tmp_path)
    client = Client(server)
    first = client.cookie
    client._cookie = None
    assert client.cookie == first and client.get("/").status == 200
    assert client.token == Client(server).token
    # It ends with the browser, as it is of no use to the next session.
    marks = client.raw("GET", f"/?token={client.token}", [("Host", client.host)]).headers["set-cookie"].lower()
    assert "max-age" not in marks and "expires" not in marks
    server.stop()


TOKEN = "t" * 40
OWN = "127.0.0.1:9900"


def ask(access, path="/", query="", method="GET", host=OWN, **headers):
    """Status and headers that the access control answers with; 299 is the application behind it."""
    sent = []

    async def send(message):
        sent.append(message)

    raw = [(name.replace("_", "-").encode(), value.encode()) for name, value in {"host": host, **headers}.items()]
    scope = {"type": "http", "method": method, "path": path, "query_string": query.encode(), "headers": raw}
    asyncio.run(access(scope, None, send))
    return sent[0]["status"], dict(sent[0]["headers"]), sent[1]["body"] if len(sent) > 1 else b""


async def behind(scope, receive, send):
    await send({"type": "http.response.start", "status": 299, "headers": []})


def access_of(**more):
    return AccessControl(behind, TOKEN, 9900, **more)


@pytest.mark.parametrize("site, status", [("same-origin", 299), ("none", 299), ("same-site", 403), ("cross-site", 403)])
def test_what_the_browser_says_of_a_request_without_origin_is_heard(site, status):
    _, headers, _ = ask(access_of(), query=f"token={TOKEN}")
    cookie = headers[b"set-cookie"].decode().partition(";")[0]
    asked = ask(access_of(), "/rec/a.rrd", cookie=cookie, sec_fetch_site=site)
    assert asked[0] == status


def test_a_link_from_elsewhere_opens_the_page_without_a_redirect():
    # A strict cookie is not sent along a redirect that another site began.
    status, headers, body = ask(access_of(), query=f"token={TOKEN}", host="localhost:9900", sec_fetch_site="cross-site")
    assert status == 200 and b"set-cookie" in headers and b"refresh" in body and TOKEN.encode() not in body


def test_a_script_may_send_the_token_as_a_header():
    assert ask(access_of(), "/api/status", authorization=f"Bearer {TOKEN}")[0] == 299
    assert ask(access_of(), "/api/status", authorization="Bearer another")[0] == 403


def tokens_file(folder, text, mode=0o600):
    path = folder / "tokens"
    path.write_text(text)
    path.chmod(mode)
    return path


ALLOWED = {
    "view": {"GET /", "GET /api/status", "GET /metrics"},
    "feed": {"GET /api/readings", "POST /api/readings"},
    "tune": {"GET /", "GET /api/status", "GET /metrics", "POST /api/command", "GET /viser/"},
}


@pytest.mark.parametrize("role", ["view", "feed", "tune", "admin"])
def test_a_token_of_a_file_opens_what_its_role_allows(tmp_path, role):
    token = "secret-of-another-program"
    grants = read_tokens(tokens_file(tmp_path, f"# who may do what\n\nprometheus {role} {token}  # since Monday\n"))
    assert token not in repr(grants)
    access = access_of(grants=grants)
    every = [
        "GET /", "GET /api/status", "GET /metrics", "GET /api/readings", "POST /api/readings", "POST /api/command",
        "GET /viser/", "POST /api/gallery/recordings/delete",
    ]  # fmt: skip
    allowed = ALLOWED.get(role, set(every)) | ({"GET /api/readings"} if role in ("view", "tune") else set())
    for words in every:
        method, path = words.split()
        bearer = f"Bearer {token}"
        status, _, body = ask(access, path, method=method, authorization=bearer)
        assert status == (299 if words in allowed else 403), words
        if status == 403:
            assert body.startswith(f"Nisus: the token of prometheus has the role {role}; this needs ".encode())
        assert ask(access, path, method=method, authorization="Bearer secret")[0] == 403
        assert ask(access, path, method=method, authorization=bearer, origin="http://elsewhere")[0] == 403


@cases(__file__, "wrong_tokens.csv")
def test_a_wrong_file_of_tokens_is_one_line(nisus, tmp_path, text, mode, reason):
    path = tokens_file(tmp_path, text, int(mode, 8))
    assert reason in nisus.refuses("run", "motor_winding", "--no-browser", "--tokens", path)
    assert "cannot be read" in nisus.refuses("run", "motor_winding", "--tokens", tmp_path / "none")


@cases(__file__, "addresses.csv")
def test_a_service_on_other_addresses_has_its_own_names_only(host, origin, status):
    access = access_of(addresses=True, public="https://twins.example.com")
    headers = {"host": host, "authorization": f"Bearer {TOKEN}"} | ({"origin": origin} if origin else {})
    assert ask(access, "/api/state", **headers)[0] == int(status)
    if host != OWN:
        assert ask(access_of(), "/api/state", **headers)[0] == 403


@pytest.mark.parametrize(
    ("named", "address"),
    [("1.2.3.4, 10.0.0.7", "10.0.0.7"), ("root admin 1.2.3.4", "unknown"), ("1.2.3.4, ", "unknown")],
)
def test_the_user_that_is_noted_cannot_be_changed_by_the_address_a_proxy_names(tmp_path, named, address):
    found = []

    async def noted(scope, receive, send):
        found.append(scope[USER])
        await behind(scope, receive, send)

    service = AccessControl(
        noted, TOKEN, 9900, public="https://twins.example.com",
        grants=read_tokens(tokens_file(tmp_path, f"bob tune {'b' * 20}\n")),
    )  # fmt: skip
    twin = AccessControl(noted, "u" * 40, 9901)
    ask(service, "/api/state", host="twins.example.com", authorization="Bearer " + "b" * 20, x_forwarded_for=named)
    ask(twin, "/api/state", host="127.0.0.1:9901", authorization="Bearer " + "u" * 40, nisus_user=" ".join(found[0]))
    assert found == [("bob", "tune", address)] * 2


@pytest.mark.parametrize("role", ["view", "feed", "tune", "admin"])
def test_a_role_is_the_same_for_one_twin_of_several(tmp_path, role):
    access = access_of(grants=read_tokens(tokens_file(tmp_path, f"ann {role} {'a' * 20}\n")))
    ann = "Bearer " + "a" * 20
    for words in ("GET /api/state", "GET /viser/", "POST /api/readings", "POST /api/command"):
        method, path = words.split()
        alone, among = (ask(access, begin + path, method=method, authorization=ann)[0] for begin in ("", "/twins/pump"))
        assert alone == among, words


def test_the_cookie_of_one_port_does_not_open_another():
    _, headers, _ = ask(access_of(), query=f"token={TOKEN}")
    value = headers[b"set-cookie"].decode().partition(";")[0].partition("=")[2]
    assert ask(AccessControl(behind, TOKEN, 9901), host="127.0.0.1:9901", cookie=f"nisus_9901={value}")[0] == 403


def test_viewer_files_are_compressed_and_kept_for_ever(tmp_path, monkeypatch):
    for name in FILES:
        (tmp_path / f"{name}.gz").write_bytes(gzip.compress(name.encode() * 1000))
    server = served(monkeypatch, lambda progress: tmp_path)
    client = Client(server)
    path = f"/viewer/{viewer_version()}/re_viewer_bg.wasm"
    head = [("Host", client.host), ("Cookie", client.cookie)]
    packed = client.raw("GET", path, [*head, ("Accept-Encoding", "gzip, br")])
    assert packed.headers["content-encoding"] == "gzip" and "immutable" in packed.headers["cache-control"]
    assert packed.headers["content-type"] == "application/wasm"
    assert gzip.decompress(packed.body) == b"re_viewer_bg.wasm" * 1000
    plain = client.raw("GET", path, head)
    assert plain.body == b"re_viewer_bg.wasm" * 1000 and "content-encoding" not in plain.headers
    server.stop()


def test_a_viewer_that_cannot_be_had_is_said_to_the_page(monkeypatch):
    def fail(progress):
        raise ConfigError("rerun-sdk: its viewer program is missing; install it")

    server = served(monkeypatch, fail)
    answer = Client(server).get(f"/viewer/{viewer_version()}/re_viewer.js")
    assert answer.status == 503 and answer.text == "rerun-sdk: its viewer program is missing; install it\n"
    server.stop()


def test_the_installed_viewer_is_unpacked_without_a_trace(tmp_path, monkeypatch, cache):
    home = tmp_path / "home"
    home.mkdir()
    for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        monkeypatch.setenv(name, str(home))
    said = []
    folder = viewer_assets(said.append)
    assert folder == cache / f"rerun-{viewer_version()}" and len(said) == 1
    assert gzip.decompress((folder / "re_viewer_bg.wasm.gz").read_bytes()).startswith(b"\0asm")
    assert b"class WebHandle" in gzip.decompress((folder / "re_viewer.js.gz").read_bytes())
    assert not list(home.iterdir()), "an analytics identity, for example"
    # From the cache the second time.
    monkeypatch.setattr(assets_module, "_served_files", None)
    assert viewer_assets(said.append) == folder and len(said) == 1


def test_the_viewer_s_program_ends_with_a_process_that_is_killed(tmp_path):
    program, number = tmp_path / "rerun", tmp_path / "number"
    program.write_text(f"#!/bin/sh\necho $$ > {number}\nexec sleep 1000\n")
    program.chmod(0o755)
    code = f"from app.web import viewer_assets as it\nit._program = lambda: {str(program)!r}\nit.viewer_assets()"
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, env=environment) as process:
        wait_for(lambda: number.is_file() and number.read_text().endswith("\n"))
        process.kill()
    command = Path(f"/proc/{number.read_text().strip()}/cmdline")  # empty of one that nobody has waited for
    wait_for(lambda: not command.exists() or not command.read_bytes())


def test_a_viewer_that_does_not_start_is_one_line(tmp_path, monkeypatch):
    program = tmp_path / "rerun"
    program.write_text("#!/bin/sh\necho it is broken\nexit 3\n")
    program.chmod(0o755)
    monkeypatch.setattr(assets_module, "_program", lambda: program)
    assert re.search("did not start.*it is broken", error_of(ConfigError, viewer_assets))
