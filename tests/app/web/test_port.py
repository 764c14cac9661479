"""A port that cannot be had is told before anything is compiled or read for a page on it."""

import socket

import pytest

import app.cli.open_twin
import app.cli.run
from app.cli.main import main
from app.web.door import check_port
from estimators.errors import ConfigError


@pytest.fixture
def taken():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        yield other.getsockname()[1]


@pytest.mark.parametrize("command", ["run", "review"])
def test_a_port_in_use_is_told_first(command, taken, monkeypatch, capsys):
    def too_late(*_):
        raise AssertionError("it went on")

    monkeypatch.setattr(app.cli.open_twin, "begin_to_compile", too_late)
    monkeypatch.setattr(app.cli.open_twin, "read_recording", too_late)
    assert main([command, "motor_winding", "--port", str(taken), "--no-browser"]) == 2
    assert capsys.readouterr().err == f"nisus: port {taken}: Address already in use; choose another with --port\n"


def test_without_a_page_the_port_does_not_matter(taken, monkeypatch):
    reached = []
    monkeypatch.setattr(app.cli.run, "prepare", reached.append)
    monkeypatch.setattr(app.cli.run, "open_session", lambda *_, **__: (_ for _ in ()).throw(ConfigError("enough")))
    assert main(["run", "motor_winding", "--port", str(taken), "--headless"]) == 2
    assert len(reached) == 1


def test_a_port_that_was_checked_is_free_again(taken):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        free = other.getsockname()[1]
    check_port(free)
    check_port(free)
    check_port(0)
    for wrong in (-1, 70000):
        with pytest.raises(ConfigError, match=f"port {wrong}: is not a port; choose another with --port"):
            check_port(wrong)
