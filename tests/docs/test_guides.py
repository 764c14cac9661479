"""The guides: Python blocks run as printed, commands exist, links lead somewhere; console commands run for releases.

The example of "Write an extension", built and installed as a package of its own, takes, sends and shows.
"""

import itertools
import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

from app.cli.main import main, parse
from config.loader import find
from tests import ROOT
from tests.app.conftest import browser, shared_chromium
from tests.app.web.page.conftest import visit
from tests.support import free_port
from tests.test_package import wheel_of
from tests.waiting import LIMIT_S, wait_for

GUIDES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
PATH_OF_NISUS = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])


def blocks(path, language):
    """Return the fenced code blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def name(path):
    return path.name


@pytest.mark.parametrize("path", [path for path in GUIDES if blocks(path, "python")], ids=name)
def test_python_blocks_run(path, tmp_path, monkeypatch):
    """In one namespace per page, from top to bottom, as a reader would enter them."""
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": path.stem}
    for k, block in enumerate(blocks(path, "python")):
        file = tmp_path / f"block_{k}.py"  # Numba wants a file for what it compiles
        file.write_text(block, encoding="utf-8")
        exec(compile(block, str(file), "exec"), names)


WRITES = (">", "--out", "--html", "--record", "--archive")
"""What stands before the file that a command writes."""


def commands(path):
    """Return the console commands of a page."""
    lines = "".join(blocks(path, "console")).splitlines()
    return [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]


in_each_page = pytest.mark.parametrize("path", [path for path in GUIDES if commands(path)], ids=name)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where a reader enters the commands."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config").symlink_to(ROOT / "config")
    return tmp_path


@in_each_page
def test_console_commands_and_what_they_read_exist(path, folder):
    """They are parsed; a file that they name is here, or an earlier command of the page wrote it."""
    for command in commands(path):
        words = shlex.split(command)
        assert shutil.which(words[0], path=PATH_OF_NISUS)
        writes = {word for before, word in itertools.pairwise(words) if before in WRITES}
        reads = {word for word in words if re.fullmatch(r"[\w/]+\.[a-z]\w*", word)} - writes
        if words[0] == "nisus":
            asked = parse(words[1:])
            if words[1] == "new":
                writes.add(f"{asked.name}.yaml")
            elif words[1] == "query":
                reads.add(str(asked.folder))
            elif getattr(asked, "twin", None):
                reads.add(str(find(asked.twin)))
        assert [word for word in reads if not (folder / word).exists()] == [], command
        for word in writes:
            (folder / word).touch()


@pytest.mark.release
@in_each_page
def test_console_commands_succeed(path, folder, capsys):
    """`nisus` runs in this process, which has it loaded, except `nisus run`, which ends with its process."""
    for command in commands(path):
        words = shlex.split(command)
        if words[0] == "nisus" and words[1] != "run":
            status, said = main(words[1:]), capsys.readouterr().err
        else:
            environment = os.environ | {"PATH": PATH_OF_NISUS, "PYTHONPATH": str(ROOT)}
            run = subprocess.run(command, shell=True, env=environment, capture_output=True, text=True)
            status, said = run.returncode, run.stderr
        # `tune` ends with 1 if it has nothing to propose, which is a result.
        assert status in ((0, 1) if command.startswith("nisus tune") else (0,)), f"{command}\n{said}"


@pytest.mark.parametrize("path", [path for path in GUIDES if blocks(path, "sh")], ids=name)
def test_other_commands_exist(path, monkeypatch):
    """Their options are parsed as the command line does; they are not run."""
    monkeypatch.chdir(ROOT)
    for line in "".join(blocks(path, "sh")).splitlines():
        words = shlex.split(line, comments=True)
        if words and words[0] == "nisus":
            parse(words[1:])


@pytest.mark.parametrize("path", GUIDES, ids=name)
def test_links_and_pictures_lead_to_files(path):
    targets = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", path.read_text(encoding="utf-8"))
    missing = [target for target in targets if "://" not in target and not (path.parent / target).exists()]
    assert not missing


@pytest.mark.parametrize("path", GUIDES, ids=name)
def test_files_that_are_named_exist(path):
    """Such as `app/engine/jobs.py`, so that a file that moves takes the guides along."""
    text = path.read_text(encoding="utf-8")
    named = re.findall(r"`((?:app|estimators|sources|config|tests|docs)/[\w/.]+)`", text)
    assert [file for file in named if not (ROOT / file).exists()] == []


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


__all__ = ["browser", "shared_chromium", "visit"]

EXAMPLE = ROOT / "docs" / "examples" / "nisus_udp"
AT = 1_760_000_000  # s since 1970


@pytest.mark.browser
def test_the_example_takes_datagrams_sends_the_state_and_shows_it(visit, tmp_path):
    copy = shutil.copytree(EXAMPLE, tmp_path / "copy", ignore=shutil.ignore_patterns("__pycache__"))
    with ZipFile(wheel_of(copy, tmp_path)) as wheel:
        wheel.extractall(site := tmp_path / "site")
    receiver, port = socket.socket(type=socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    receiver.bind(("127.0.0.1", 0))
    receiver.settimeout(LIMIT_S)

    def sent():
        return json.loads(receiver.recv(65_535))

    text = (ROOT / "config" / "twins" / "motor_winding.yaml").read_text()
    text = re.sub(r"source:\n  type: simulator\n(  .*\n)*", f"source: {{type: udp, port: {port}}}\n", text)
    out = f"outputs: {{every: 0, udp: {{host: 127.0.0.1, port: {receiver.getsockname()[1]}}}}}\n"
    (tmp_path / "motor.yaml").write_text(text + out)
    words = ["run", "motor.yaml", "--no-browser", "--log-format", "text", "--port", str(free_port())]
    process = subprocess.Popen(
        [sys.executable, "-m", "app.cli.main", *words], cwd=tmp_path, text=True,
        stdout=subprocess.PIPE, stderr=(tmp_path / "lines").open("w"),
        env=os.environ | {"PYTHONPATH": f"{site}:{ROOT}"},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        found = (re.search(r"http://127.0.0.1:\d+/\?token=\S+", line) for line in process.stdout)
        url = next(match[0] for match in found if match)
        sender = socket.socket(type=socket.SOCK_DGRAM)
        for k in range(3):
            message = {"time": (AT + k) * 10**9, "values": {"winding": 41.5}}
            sender.sendto(json.dumps(message).encode(), ("127.0.0.1", port))
        sender.sendto(b"nonsense", ("127.0.0.1", port))
        wait_for(lambda: sent()["time_ns"] == (AT + 2) * 10**9)
        page = visit(url)
        page.get_by_role("tab", name="States", exact=True).click()
        shown = wait_for(lambda: re.findall(r"(\S+) (-?\d+\.\d\d) (\S+)", page.locator("#panel-0").inner_text()))
        states = sent()["states"]
        assert [(name, unit) for name, _, unit in shown] == [(item["name"], item["unit"]) for item in states]
        # The estimate moves on between the two, by less than that: its rate is 0.2 °C/s.
        assert [float(value) for _, value, _ in shown] == pytest.approx([item["value"] for item in states], abs=2.0)
        assert "udp: Expecting value" in wait_for((tmp_path / "lines").read_text)
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(LIMIT_S)
        receiver.close()
