"""A model whose f never returns from some state: signals end the program, and the page names the function."""

import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

import app.engine.watchdog
from app.engine.commands import SetTuning
from app.engine.watchdog import CHECK_AFTER_S, STALLED_AFTER_S, Watchdog, unanswered
from app.record.reader import finished, read_recording
from tests import ROOT
from tests.app.scripted import Stepped, fresh_status
from tests.waiting import LIMIT_S, wait_for

MODEL = """
from estimators.model import Noise, Row, Sensor, State, StateSpaceModel


def f(x, u, p, dt, out):
    while x[0] > 50.0 and dt > 0.0:
        pass
    out[0] = x[0]


def h(x, u, p, out):
    out[0] = x[0]


Looping = StateSpaceModel(
    name="looping",
    title="A model whose f loops above 50",
    states=(State("x", "1", mean=1.0, std=1.0),),
    noises=(Noise("x", "1", variance=1.0),),
    sensors=(Sensor("s", (Row("s", "1", variance=1e-4),), h=h),),
    f=f,
)
"""
TWIN = """
model: ./looping.py:Looping
estimator: {estimator}
gate: null
source:
  type: table
  files: log.csv
  time: {{column: t, unit: s}}
  sensors:
    s: {{columns: s}}
"""


@pytest.fixture
def looping(tmp_path):
    """looping(estimator): a twin of 20 readings, of which the eleventh leads where f loops; the next comes 5 s later.

    So it is folded before them, however late a busy machine reads the file.
    """

    def write(estimator="ekf"):
        (tmp_path / "looping.py").write_text(MODEL)
        (tmp_path / "looping.yaml").write_text(TWIN.format(estimator=estimator))
        values = [1.0] * 10 + [100.0] * 10
        rows = "".join(f"{0.1 * k + 5.0 * (k > 10):.1f},{value}\n" for k, value in enumerate(values))
        (tmp_path / "log.csv").write_text(f"t,s\n{rows}")
        return tmp_path / "looping.yaml"

    return write


class Child:
    """A command of its own process, whose lines on standard error are kept."""

    def __init__(self, *words):
        self.lines = []
        self.process = subprocess.Popen(
            [sys.executable, "-m", "app.cli.main", *map(str, words)],
            cwd=ROOT,
            stderr=subprocess.PIPE,
            # A shell that starts the tests in the background has its children ignore Ctrl-C.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
            stdout=subprocess.DEVNULL,
            text=True,
        )
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        self.lines.extend(self.process.stderr)

    def said(self, text):
        return [line for line in self.lines if text in line]


def test_a_run_whose_f_loops_says_so_and_ends_when_asked(looping, tmp_path):
    path = tmp_path / "run.rrd"
    child = Child("run", looping("ukf"), "--headless", "--record", path, "--duration", "600")
    try:
        wait_for(lambda: child.said("has not returned") or child.process.poll() is not None)
        (line,) = child.said("has not returned")
        where = MODEL.splitlines().index("def f(x, u, p, dt, out):") + 1
        assert f"looping.py:{where}: model looping: f(x, u, dt) at x = [" in line and "the estimate stays" in line
        # Whoever ends a run waits some seconds for a recording, of which opening the file may take more.
        wait_for(lambda: path.exists() and path.stat().st_size > 2000)
        os.kill(child.process.pid, signal.SIGINT)
        assert child.process.wait(LIMIT_S) == 0
    finally:
        child.process.kill()
    recorded = read_recording(path)
    assert finished(path) and recorded.rows == 11
    assert any("has not returned" in text for _, _, text in recorded.notices)


def test_a_fold_whose_f_loops_says_so_and_ends_when_asked(looping):
    child = Child("fold", looping())
    try:
        wait_for(lambda: child.said("has not returned") or child.process.poll() is not None)
        assert "f(x, u, dt) at x = [" in child.said("has not returned")[0]
        os.kill(child.process.pid, signal.SIGINT)
        assert child.process.wait(LIMIT_S) == 130
    finally:
        child.process.kill()


class Work:
    """Stands for a fold; its model's questions are those given."""

    class model:  # noqa: N801
        black_box = False

    def __init__(self, *questions):
        self.questions = questions


@pytest.fixture
def asked_of_work(monkeypatch):
    monkeypatch.setattr(app.engine.watchdog, "questions_of", lambda work: iter(getattr(work, "questions", ())))


def test_work_that_takes_long_is_named_only_if_a_question_is_not_answered(monkeypatch, asked_of_work):
    now, said, leave = 0.0, [], threading.Event()
    watchdog = Watchdog(lambda text, level: said.append((level, text)), clock=lambda: now)
    with monkeypatch.context() as patch, watchdog.watched(Work(("f", lambda: None), ("h", lambda: None))):
        patch.setattr(app.engine.watchdog, "ANSWER_TIMEOUT_S", LIMIT_S)
        now = CHECK_AFTER_S + 1.0
        watchdog.check()
        assert watchdog.text is None
        now = STALLED_AFTER_S + 1.0
        watchdog.check()
        assert watchdog.text is not None and watchdog.text.startswith("a fold has not returned for 61 s; ")
    watchdog.check()
    assert watchdog.text is None and [level for level, _ in said] == ["error", "info"]
    with watchdog.watched(Work(("f", lambda: None), ("h at x", leave.wait), ("never asked", lambda: None))):
        now += CHECK_AFTER_S - 0.1
        watchdog.check()
        assert watchdog.text is None
        now += 0.2
        watchdog.check()
        assert watchdog.text is not None and watchdog.text.startswith("h at x has not returned for 3 s; ")
    leave.set()


def test_questions_are_asked_until_one_is_not_answered():
    asked, leave = [], threading.Event()
    questions = [(str(k), lambda k=k: asked.append(k)) for k in range(5)]
    assert unanswered(questions, LIMIT_S) is None and asked == [0, 1, 2, 3, 4]
    assert unanswered([*questions, ("loop", leave.wait), ("after", lambda: asked.append("after"))], 1.0) == "loop"
    leave.set()
    assert np.all(np.array(asked[:10]) == [*range(5)] * 2)


def errors(engine):
    return [line.text for line in engine.notices.since(0) if line.level == "error"]


def test_a_refold_that_never_returns_is_given_up_and_the_next_one_made(monkeypatch, asked_of_work):
    monkeypatch.setattr(app.engine.watchdog, "CHECK_AFTER_S", 0.0)
    monkeypatch.setattr(app.engine.watchdog, "ANSWER_TIMEOUT_S", 0.1)
    leave, engine = threading.Event(), Stepped(100).engine
    stuck = Work(("f at x", leave.wait))
    stuck.advance = lambda limit: leave.wait()
    engine.start()
    try:
        with monkeypatch.context() as patch:
            patch.setattr(engine, "_make_fold", lambda *args: stuck)
            engine.submit(SetTuning("Q.rate", 0.1))
            wait_for(lambda: errors(engine))
        (text,) = errors(engine)
        assert text.startswith("not folded again: f at x has not returned for ") and "running estimate goes on" in text
        assert engine.tuning is engine.twin.tuning and not fresh_status(engine).refolding
        engine.submit(SetTuning("Q.rate", 0.2))
        wait_for(lambda: engine.folded_with()[0].get("Q.rate") == 0.2)
        # What comes of the first one after all is no answer any more.
        leave.set()
        engine.submit(SetTuning("Q.rate", 0.3))
        wait_for(lambda: engine.folded_with()[0].get("Q.rate") == 0.3)
        assert fresh_status(engine).revision == 2 and len(errors(engine)) == 1
    finally:
        leave.set()
        engine.stop()
