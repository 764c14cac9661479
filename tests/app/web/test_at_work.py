"""A slow fold: the page answers meanwhile; requests for rows wait for one portion of it.

The model's solver is let on by the test, step by step, so that the fold stands where the test wants it.
"""

import json
import threading

import numpy as np
import pytest
from websockets.sync.client import connect

import app.engine.watchdog
from app.engine.commands import SetTuning
from app.engine.engine import Engine
from app.web.server import PageServer
from tests.app.scripted import Scripted, readings, row_count, solved_by, twin
from tests.app.served import SECRET, Client
from tests.support import SECOND
from tests.waiting import LIMIT_S, wait_for

READINGS = 40


class Solver:
    """The motor's winding behind a solver that answers as often as it is let."""

    def __init__(self):
        self.at_work, self.left = threading.Event(), threading.Semaphore(0)
        self.held = ""
        """The thread that it holds up."""

    def called(self, dt):
        if dt > 0.0 and threading.current_thread().name == self.held:
            self.at_work.set()
            self.left.acquire()

    def hold(self, thread):
        self.at_work.clear()
        self.held = thread

    def let_go(self):
        self.held = ""
        self.left.release(1000)


@pytest.fixture
def running(monkeypatch, tmp_path):
    """An engine behind its page whose solver stands still, in the fold of the second reading."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("app.web.server.viewer_assets", lambda progress: tmp_path)
    # Nobody gives the solver up.
    monkeypatch.setattr(app.engine.watchdog, "CHECK_AFTER_S", float("inf"))
    solver, source = Solver(), Scripted()
    engine = Engine(twin(model=solved_by(solver.called), estimator="filterpy-ukf"), lambda report: source)
    server = PageServer(engine, port=0, viser_port=None, secret=SECRET)
    server.start()
    engine.start()
    solver.hold("engine")
    times = np.arange(1, READINGS + 1) * 0.5
    source.put(readings(times, 40.0 + times))
    assert solver.at_work.wait(LIMIT_S)
    yield engine, server, solver
    solver.let_go()
    server.stop()
    engine.stop()


def test_the_page_and_what_it_asks_are_answered_while_the_fold_is_at_work(running):
    engine, server, solver = running
    client = Client(server)
    # What needs the fold waits in a thread of its own; nothing else waits for that.
    waiting = threading.Thread(target=client.get, args=("/api/fit",), daemon=True)
    waiting.start()
    for target in ("/", "/api/status", "/api/model", "/api/episodes", "/api/faults", "/api/recordings"):
        assert client.get(target).status == 200, target
    assert client.post("/api/command", {"command": "SetTuning", "key": "Q.rate", "value": 0.5}).status == 202
    assert waiting.is_alive()
    assert engine.span()[0] <= 0.5e9
    told = json.loads(client.get("/api/status").text)
    assert told["twin"] == "scripted" and told["tuning"]["Q.rate"] == engine.twin.tuning.get("Q.rate")
    # The engine takes the command once the fold returns.
    solver.let_go()
    waiting.join(LIMIT_S)
    assert not waiting.is_alive()
    wait_for(lambda: engine.status().revision == 1 and not engine.status().refolding)
    assert row_count(engine) == READINGS


def test_a_page_that_looks_at_charts_is_told_of_the_twin_while_the_fold_is_at_work(running):
    _, server, _ = running
    client = Client(server)
    with connect(
        f"ws://{client.host}/api/stream", origin=client.origin, additional_headers={"Cookie": client.cookie}
    ) as stream:
        assert "boot" in json.loads(stream.recv(LIMIT_S))
        query = {"columns": ["mean:winding"], "points": 100}
        stream.send(json.dumps({"streams": {"charts": query}, "pair": ["winding", "rate"]}))
        # Every word on the twin, though its rows are asked for and do not come.
        wait_for(lambda: "the measurements so far are being folded (" in stream.recv(LIMIT_S))
        stream.send(json.dumps({"streams": {"charts": None}}))
    with connect(
        f"ws://{client.host}/api/stream", origin=client.origin, additional_headers={"Cookie": client.cookie}
    ) as stream:
        said = [json.loads(stream.recv(LIMIT_S)) for _ in range(2)]
    assert any("status" in message for message in said)


def test_rows_can_be_read_between_the_pieces_of_a_fold(running):
    engine, _, solver = running
    found: list[int] = []
    reader = threading.Thread(target=lambda: found.append(row_count(engine)), daemon=True)
    reader.start()

    def read():
        """Let the solver on, an answer at a time, while the reader waits for its turn."""
        if engine._lock._outer.locked() and not solver.left._value:
            solver.left.release()
        return not reader.is_alive()

    wait_for(read)
    # The first reading is a piece, as nothing is known of the fold; four times as many are the next at most.
    assert 2 <= found[0] <= 5 and engine.span()[1] == READINGS * SECOND // 2


def test_a_refold_catches_up_beside_the_fold_that_is_shown(running):
    engine, _, solver = running
    solver.let_go()
    wait_for(lambda: row_count(engine) == READINGS)
    solver.left = threading.Semaphore(0)
    solver.hold("refold 0")
    engine.submit(SetTuning("Q.rate", 0.5))
    assert solver.at_work.wait(LIMIT_S)
    engine.source.put(readings([20.5, 21.0], [60.0, 61.0]))
    wait_for(lambda: row_count(engine) == READINGS + 2)
    # Now the engine stands still in what the refold has not seen, and the rows of before can be read all the same.
    solver.hold("engine")
    solver.left.release()
    assert solver.at_work.wait(LIMIT_S)
    assert row_count(engine) == READINGS + 2 and engine.status().refolding and engine.status().revision == 0
    solver.let_go()
    wait_for(lambda: engine.status().revision == 1 and not engine.status().refolding)
    assert row_count(engine) == READINGS + 2
