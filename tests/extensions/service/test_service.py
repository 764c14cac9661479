"""A service of several twins: one page each, processes of their own with what they need loaded, and an overview."""

import http.client
import io
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from urllib.error import HTTPError
from urllib.parse import unquote, urljoin
from urllib.request import ProxyHandler, Request, build_opener

import pytest
from websockets.sync.client import connect

from app.cli.main import main
from tests import ROOT
from tests.cases import cases
from tests.support import run_python
from tests.waiting import LIMIT_S, wait_for

TOKENS = {"ann": ("view", "a" * 20), "bob": ("tune", "b" * 20), "plc": ("feed", "c" * 20), "eve": ("admin", "e" * 20)}

OPENER = build_opener(ProxyHandler({}))


AS_INSTALLED = "import sys; del sys.path[0]; from app.cli.main import main; sys.exit(main())"
"""A console script does not have the working directory in its path."""


class Served:
    """A running `nisus serve`, and requests to it."""

    def __init__(self, folder, *arguments, **variables):
        self.folder = folder
        self.process = subprocess.Popen(
            [sys.executable, "-c", AS_INSTALLED, "serve", *arguments],
            cwd=folder, text=True, stdout=subprocess.PIPE, stderr=(folder / "lines").open("w"),
            env=os.environ | {"PYTHONPATH": str(ROOT), "NISUS_SERVE_PORT": "0"} | variables,
        )  # fmt: skip
        for line in self.process.stdout:
            if found := re.search(r"(http://127.0.0.1:\d+)/\?token=(\S+)", line):
                self.url, self.token = found.groups()
                break

    def ask(self, path, body=None, token=None, **headers):
        """Status and content of an answer; JSON is read."""
        data = None if body is None else json.dumps(body).encode()
        headers = {"Authorization": f"Bearer {token or self.token}", "Content-Type": "application/json"} | headers
        try:
            with OPENER.open(Request(self.url + path, data, headers), timeout=LIMIT_S) as answer:
                text, status = answer.read().decode(), answer.status
        except HTTPError as error:
            text, status = error.read().decode(), error.code
        return status, json.loads(text) if text[:1] in "[{" else text

    def twins(self):
        return {twin["name"]: twin for twin in self.ask("/api/session")[1]["twins"]}

    def wait(self, condition):
        """Wait until the twins fulfil a condition; return them."""
        try:
            return wait_for(lambda: condition(found := self.twins()) and found, every_s=0.2)
        except AssertionError as error:
            error.add_note(f"{self.twins()}\n{self.lines()[-5000:]}")
            raise

    def lines(self):
        return (self.folder / "lines").read_text()

    def stop(self):
        self.process.terminate()
        self.process.wait(LIMIT_S)
        self.process.stdout.close()


def write_tokens(folder):
    tokens = folder / "tokens"
    tokens.write_text("".join(f"{name} {role} {token}\n" for name, (role, token) in TOKENS.items()))
    tokens.chmod(0o600)


def all_run(twins):
    return all(twin["state"] == "running" for twin in twins.values())


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    folder = tmp_path_factory.mktemp("service")
    for name in ("north", "south"):
        text = (ROOT / "config" / "twins" / "motor_winding.yaml").read_text()
        source = "source: {type: push}\n" if name == "south" else "source:\n  type: simulator\n"
        (folder / f"{name}.yaml").write_text(re.sub(r"source:\n  type: simulator\n(  .*\n)*", source, text))
    write_tokens(folder)
    # A file of the user's own with the name of a library: the processes of twins do not import it.
    (folder / "click.py").write_text("raise RuntimeError('this is not click')\n")
    running = Served(
        folder, "north.yaml", "south.yaml", "--tokens", "tokens", "--store", "stores", "--log-format", "json"
    )
    running.wait(all_run)
    yield running
    running.stop()
    assert running.process.returncode == 0


def test_each_twin_has_its_page_behind_one_port(served):
    for name in ("north", "south"):
        status, page = served.ask(f"/twins/{name}/")
        assert status == 200 and 'src="../../page/page.js"' in page
        assert served.ask("/page/page.js")[0] == 200
        assert served.ask(f"/twins/{name}/api/state")[1]["twin"] == name
    assert served.ask("/twins/east/api/state") == (404, "Nisus: east is no twin of this service.\n")
    headers = {"Authorization": f"Bearer {served.token}"}
    address = f"{served.url.replace('http', 'ws')}/twins/north/api/stream"
    with connect(address, origin=served.url, additional_headers=headers, proxy=None, open_timeout=LIMIT_S) as page:
        assert json.loads(page.recv(timeout=LIMIT_S))["boot"]
    cards = {card["name"]: card for card in served.ask("/api/gallery")[1]}
    assert cards["north"]["states"] == 2 and cards["south"]["source"] == "messages"
    assert served.ask("/readyz") == (200, "ok\n")


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_processes_share_most_of_what_they_import(served):
    for twin in served.twins().values():
        lines = Path(f"/proc/{twin['pid']}/smaps_rollup").read_text().splitlines()[1:]
        size = {name: int(value.split()[0]) for name, value in (line.split(":") for line in lines)}
        # 111 and 96 MB; when each process loads Numba's tables, or collects the garbage of imports, 58 and 149 MB.
        assert size["Shared_Dirty"] > 0.8 * size["Private_Dirty"]


def test_roles_hold_for_every_twin_and_commands_are_noted_with_their_user(served):
    token = {name: token for name, (_, token) in TOKENS.items()}
    edit = {"command": "SetTuning", "key": "Q.temperature", "value": 0.5}
    earlier = len(served.ask("/twins/north/api/audit")[1])
    assert served.ask("/twins/north/api/command", edit, token["ann"])[0] == 403
    assert served.ask("/twins/north/api/command", edit, token["bob"])[0] == 202
    assert served.ask("/api/gallery/stop", {"twin": "north"}, token["bob"])[0] == 403
    message = {"time": "2026-01-01T00:00:00Z", "values": {"winding": 40.0}, "source": "plc", "sequence": 1}
    status, answer = served.ask("/twins/south/api/readings", message, token["plc"])
    assert (status, answer["accepted"], answer["stored"]) == (200, 1, True)
    assert served.ask("/twins/south/api/state", token=token["plc"])[0] == 403
    (entry,) = served.ask("/twins/north/api/audit", token=token["ann"])[1][earlier:]
    assert (entry["user"], entry["role"], entry["address"]) == ("bob", "tune", "127.0.0.1")
    assert entry["path"] == "/api/command" and entry["body"] == edit
    # A browser exchanges the token of its user for a cookie, with the same role.
    connection = http.client.HTTPConnection(served.url.removeprefix("http://"), timeout=LIMIT_S)
    connection.request("GET", f"/?token={token['ann']}")
    answer = connection.getresponse()
    cookie = answer.getheader("set-cookie").partition(";")[0]
    answer.read()
    assert answer.status == 303 and token["ann"] not in cookie
    for path, expected in (("/twins/north/api/state", 200), ("/api/gallery", 200)):
        connection.request("GET", path, headers={"Cookie": cookie})
        answer = connection.getresponse()
        answer.read()
        assert answer.status == expected
    connection.request(
        "POST", "/twins/north/api/command", json.dumps(edit), {"Cookie": cookie, "Content-Type": "application/json"}
    )
    assert connection.getresponse().status == 403
    connection.close()


def test_a_body_without_a_length_and_an_odd_name_reach_the_twin_and_no_other_site(served):
    connection = http.client.HTTPConnection(served.url.removeprefix("http://"), timeout=LIMIT_S)
    headers = {"Authorization": f"Bearer {served.token}", "Content-Type": "application/x-ndjson"}
    lines = [b'{"values": {"winding": 40.0}, "sour', b'ce": "pipe", "sequence": 1}\n', b"{broken\n"]
    connection.request("POST", "/twins/south/api/readings", iter(lines), headers, encode_chunked=True)
    answer = connection.getresponse()
    counts = json.loads(answer.read())
    assert (answer.status, counts["accepted"], counts["refused"]) == (200, 1, 1)
    assert len(answer.msg.get_all("date")) == 1
    # The last two are redirects of the twin's own process, which knows neither the port nor the path of the service.
    for path, code in (("https:site.example", 308), ("%3Fa%2541", 308), ("south/page", 307), ("south/api/runs/", 307)):
        connection.request("GET", f"/twins/{path}", headers=headers)
        answer = connection.getresponse()
        assert (answer.status, answer.read()) == (code, b"")
        place = urljoin(f"{served.url}/twins/{path}", answer.getheader("location"))
        assert unquote(place) == unquote(f"{served.url}/twins/{path[:-1] if path[-1] == '/' else f'{path}/'}")
    connection.close()


def test_lines_are_pushed_to_a_twin_of_the_service_by_its_address(served, monkeypatch, capsys):
    token = TOKENS["plc"][1]
    for place, code, text in (
        ("/twins/south/", 0, "1 accepted"),
        ("/twins/south", 0, "1 accepted"),
        ("/", 2, "several twins, whose interfaces are at /twins/NAME/api/readings; NAME is one of north, south"),
    ):
        monkeypatch.setattr("sys.stdin", io.StringIO("winding\n40.5\n"))
        user = token if code == 0 else served.token
        assert main(["push", f"{served.url}{place}?token={user}"]) == code
        found = capsys.readouterr()
        assert text in found.out + found.err


def test_one_twin_is_stopped_and_started_alone(served):
    before, earlier = served.twins(), len(served.ask("/twins/north/api/audit")[1])

    def set_to():
        return served.ask("/twins/north/api/status")[1]["tuning"]["Q.rate"]

    edit = {"command": "SetTuning", "key": "Q.rate", "value": 0.25}
    assert set_to() != 0.25 and served.ask("/twins/north/api/command", edit, TOKENS["bob"][1])[0] == 202
    wait_for(lambda: set_to() == 0.25)
    assert served.ask("/api/gallery/stop", {"twin": "north"})[0] == 202
    found = served.wait(lambda twins: twins["north"]["state"] == "stopped")
    assert found["south"]["starts"] == before["south"]["starts"] and list(found)[-1] == "north"
    assert served.ask("/twins/north/api/state")[0] == 503
    assert served.ask("/api/gallery/start", {"twin": "north"})[0] == 202
    served.wait(all_run)
    # Its edit and its audit log are continued.
    assert set_to() == 0.25

    def three():
        return len(found := served.ask("/twins/north/api/audit")[1][earlier:]) >= 3 and found

    entries = wait_for(three, every_s=0.1)
    assert [(entry["user"], entry["path"]) for entry in entries] == [
        ("bob", "/api/command"), ("session", "/api/gallery/stop"), ("session", "/api/gallery/start"),
    ]  # fmt: skip


def test_a_twin_that_ends_is_started_again_and_no_other_notices(served):
    before = served.twins()
    os.kill(before["north"]["pid"], signal.SIGSEGV)
    served.wait(lambda twins: twins["north"]["starts"] > before["north"]["starts"] and all_run(twins))
    after = served.twins()
    assert after["south"]["pid"] == before["south"]["pid"] and after["south"]["starts"] == before["south"]["starts"]
    lines = [json.loads(line) for line in served.lines().splitlines()]
    assert [line for line in lines if line["level"] == "error" and line["twin"] == "north"][-1]["text"] == (
        "ended by SIGSEGV; started again in 1 s, then less often"
    )


def test_a_folder_is_watched_and_a_twin_that_cannot_start_is_one_line(tmp_path):
    folder = tmp_path / "twins"
    folder.mkdir()
    (folder / "good.yaml").write_text((ROOT / "config" / "twins" / "motor_winding.yaml").read_text())
    (folder / "bad.yaml").write_text("model: motor_winding\n")
    write_tokens(tmp_path)
    running = Served(tmp_path, "twins", "--tokens", "tokens")
    try:
        found = running.wait(lambda twins: twins["good"]["state"] == "running" and twins["bad"]["state"] == "failed")
        assert found["bad"]["text"] == "twins/bad.yaml:1: source is missing; add it" and list(found) == ["bad", "good"]
        for token in (running.token, TOKENS["ann"][1]):
            assert running.ask("/readyz", token=token) == (503, "1 twin(s) do not run: bad\n")
        for token in ("none", TOKENS["plc"][1]):
            assert running.ask("/readyz", token=token) == (503, "not ready\n")
        (folder / "bad.yaml").unlink()
        (folder / "good.yml").write_text("model: motor_winding\n")
        (folder / "\u200b .yaml").write_text("model: motor_winding\n")
        running.wait(lambda twins: list(twins) == ["good"] and running.lines().count("rename") == 2)
        assert r"twins/\u200b .yaml': a twin has the name of its file, which is blank; rename it" in running.lines()
        assert running.lines().count("twins/good.yml: good.yaml is a twin of this name already; rename the file") == 1
        assert running.twins()["good"]["starts"] == 1
    finally:
        running.stop()


def test_alerts_link_to_the_page_of_the_twin_at_the_service(tmp_path, hook):
    public = "https://twins.example.com"
    log = json.dumps({"receivers": {"log": hook.section}})
    text = (ROOT / "config" / "twins" / "motor_winding.yaml").read_text()
    always = "alerts: [{state: temperature, above: -1000, after: 0}]"
    (tmp_path / "pump 1.yaml").write_text(f"{text}\noutputs: {log}\n{always}\n")
    write_tokens(tmp_path)
    running = Served(tmp_path, "pump 1.yaml", "--tokens", "tokens", "--public", public)
    try:
        running.wait(lambda _: hook.alerts)
        alert = hook.alerts[0]
        assert alert["link"] == f"{public}/twins/pump%201/alarms#limit-of-a-state"
        # A link has no token.
        assert running.ask(alert["link"].removeprefix(public))[0] == 200
    finally:
        running.stop()


@cases(__file__, "refused_services.csv")
def test_a_service_that_cannot_be_is_one_line(capsys, arguments, line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / " .yaml").write_text("model: motor_winding\n")
    assert main(["serve", *shlex.split(arguments)]) == 2
    assert line in capsys.readouterr().err


PROGRAM = """
import json, sys
from app.extensions.service import preloaded
from config.schema import TwinSection
complete, before = TwinSection.__pydantic_complete__, {*sys.modules}
from pathlib import Path
from app.cli.open_twin import FileOpener, open_session, opened_twin
from app.web.gallery.gallery import StartRequest
from app.web.session import Page
opener = FileOpener()
opening = opener.made_ready(opened_twin("motor_winding"))
session = open_session(opening, StartRequest("motor_winding"), opener, page=Page(0, False, overview="../../"),
                       recordings=Path(sys.argv[1]))
session.start()
print(json.dumps([complete, sorted({*sys.modules} - before)]))
session.stop()
"""


def test_a_twin_opens_without_further_libraries(tmp_path):
    complete, loaded = json.loads(run_python(PROGRAM, tmp_path, timeout=LIMIT_S).stdout.splitlines()[-1])
    assert complete
    assert [name for name in loaded if name.split(".")[0] in ("PIL", "app", "config", "imageio")] == []
