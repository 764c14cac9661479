"""Filters are compiled by other processes; the running one goes on meanwhile, and what follows it is the cold fold.

What takes long here is a stand-in for the compiler: it waits until the test lets it go on. The oracle of every track is
a fold of the same log that knows nothing of all this.
"""

import os
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from app.engine.commands import Record, SetEstimator, SetTuning
from app.engine.compile_queue import CompileQueue
from app.engine.compilers import MAX_COMPILERS, Compiler, first_compilers
from app.engine.engine import Engine
from app.record.reader import read_recording
from app.record.writer import Recorder
from estimators.fold import Fold
from estimators.numerics.cache import cache_folder
from estimators.numerics.jit import threaded
from estimators.pieces import LOOP, Piece
from estimators.registry import ESTIMATORS
from estimators.tuning import Tuning
from sources.pieces import FRAMES, is_made, pieces_of
from tests.app.engine.test_engine import reference as cold
from tests.app.engine.test_engine import series
from tests.app.record.test_parts import refold
from tests.app.scripted import MODEL, Scripted, fresh_status, notice_texts, pull_all, readings, row_count, twin
from tests.support import assert_same, measured, run_python
from tests.waiting import LIMIT_S, wait_for


def paper(folder: Path, what: str, piece: Piece) -> Path:
    return folder / f"{what} {piece.of} {piece.place}"


def slow_work(folder: Path, piece: Piece) -> None:
    """In another process: says who does it, then waits to be let go on."""
    begun = paper(folder, "begun", piece)
    begun.with_suffix(".new").write_text(f"{os.getpid()} {os.nice(0)} {time.monotonic_ns()}")
    begun.with_suffix(".new").rename(begun)
    wait_for(lambda: paper(folder, "go", piece).exists() or (folder / "go").exists(), every_s=0.005)
    if paper(folder, "fail", piece).exists():
        raise RuntimeError("as asked")
    paper(folder, "done", piece).touch()


@pytest.fixture
def shop(tmp_path):
    """A queue whose work is `slow_work`; each filter given is as many pieces as its number says."""
    shops = []

    def open_shop(**counts):
        pieces = {name: [Piece(name, place) for place in range(count)] for name, count in counts.items()}
        if LOOP in pieces:
            pieces[LOOP][-1] = Piece(LOOP, counts[LOOP] - 1, tuple(range(counts[LOOP] - 1)))
        shops.append(
            CompileQueue(
                [name for name in counts if name != LOOP],
                pieces=lambda name: pieces.get(name, []),
                work=partial(slow_work, tmp_path),
                is_done=lambda piece: paper(tmp_path, "done", piece).exists(),
            )
        )
        return shops[-1]

    yield open_shop
    for item in shops:
        item.stop()


@pytest.fixture
def started(shop):
    engines = []

    def start(**counts):
        source, compile_queue = Scripted(), shop(**counts)
        compile_queue.start()
        engine = Engine(twin(), lambda report: source, compile_queue=compile_queue)
        engines.append(engine)
        engine.start()
        return engine, source

    yield start
    for engine in engines:
        engine.stop()


def begun(tmp_path, piece):
    """Process, niceness and time of a piece that was begun; None before."""
    path = paper(tmp_path, "begun", piece)
    return tuple(map(int, path.read_text().split())) if path.exists() else None


def test_readings_are_folded_while_another_filter_is_compiled_and_the_swap_loses_nothing(started, tmp_path):
    engine, source = started(ukf=2)
    times, values = series(300)
    source.put(readings(times[:100], values[:100]))
    wait_for(lambda: row_count(engine) == 100)
    engine.submit(SetEstimator("ukf"))
    wait_for(lambda: begun(tmp_path, Piece("ukf", 0)) and fresh_status(engine).awaited == "ukf")
    assert begun(tmp_path, Piece("ukf", 0))[0] != os.getpid()
    for k in range(100, 200):
        source.put(readings(times[k : k + 1], values[k : k + 1]))
        wait_for(lambda upto=k + 1: row_count(engine) == upto)
    status = fresh_status(engine)
    assert (status.revision, engine.folded_with()[1], status.awaited) == (0, "kf", "ukf")
    assert status.refolding and status.compiling["ukf"] > 0.0
    assert_same(pull_all(engine).track, cold(times[:200], values[:200], "kf"))
    (tmp_path / "go").touch()
    wait_for(lambda: fresh_status(engine).revision == 1 and not fresh_status(engine).refolding)
    source.put(readings(times[200:], values[200:]))
    wait_for(lambda: row_count(engine) == 300)
    status = fresh_status(engine)
    assert (engine.folded_with()[1], status.awaited, status.compiling) == ("ukf", None, {})
    assert_same(pull_all(engine).track, cold(times, values, "ukf"))
    assert_same(engine.revisions.previous().track, cold(times[:200], values[:200], "kf"))


def test_before_the_first_filter_is_compiled_the_log_grows_and_nothing_is_estimated(started, tmp_path):
    engine, source = started(**{LOOP: 3}, kf=1)
    times, values = series(200)
    source.put(readings(times[:150], values[:150]))
    wait_for(lambda: engine.span()[1] == round(times[149] * 1e9))
    status, belief = fresh_status(engine), engine.belief()
    assert row_count(engine) == 0 and status.t is None and status.health == 0 and "kf is being compiled" in status.cause
    assert status.awaited == "kf" and engine.here() is None and engine.last_events() is None
    np.testing.assert_array_equal(belief.mean, MODEL.prior_mean)
    np.testing.assert_array_equal(np.sqrt(np.diag(belief.cov)), MODEL.prior_std)
    # The last piece of the loop contains the others: it is not begun before they are there.
    wait_for(lambda: begun(tmp_path, Piece(LOOP, 0)) and begun(tmp_path, Piece(LOOP, 1)))
    assert begun(tmp_path, Piece(LOOP, 2)) is None
    engine.submit(SetTuning("Q.rate", 0.5))
    (tmp_path / "go").touch()
    wait_for(lambda: row_count(engine) == 150)
    source.put(readings(times[150:], values[150:]))
    wait_for(lambda: row_count(engine) == 200)
    assert_same(pull_all(engine).track, cold(times, values, "kf", Tuning.of(MODEL).set("Q.rate", 0.5)))
    (run,) = engine.revisions.runs
    assert run.number == fresh_status(engine).revision == 0 and run.tuning.get("Q.rate") == 0.5


class OneFilter(CompileQueue):
    """A queue that says whether its filter is compiled."""

    compiled = False

    def ready(self, name):
        return self.compiled


def test_a_late_reading_reaches_the_first_fold_that_was_begun_without_it():
    """The first refold has copied the log when a reading of before the copy's end arrives; no event is folded yet."""
    source, compile_queue, (times, values) = Scripted(), OneFilter(), series(300)
    engine = Engine(twin(), lambda report: source, compile_queue=compile_queue)
    source.put(readings(np.delete(times, 100), np.delete(values, 100)))
    engine.settle()
    assert engine.status().t is None
    compile_queue.compiled = True
    engine.submit(SetTuning("R.winding", 2.0))
    source.put(readings(times[100:101], values[100:101]))
    engine.settle()
    pull = pull_all(engine)
    np.testing.assert_array_equal(pull.events.value[:, 0], values)
    assert_same(pull.track, cold(times, values, "kf", Tuning.of(MODEL).set("R.winding", 2.0)))
    engine.stop()


def test_a_recording_that_begins_before_the_first_filter_holds_all_of_it(started, tmp_path):
    engine, source = started(kf=1)
    recorder = engine.recorder = Recorder(engine, lambda stream: lambda pull: None)
    times, values = series(120)
    source.put(readings(times[:60], values[:60]))
    wait_for(lambda: engine.span()[1] == round(times[59] * 1e9))
    engine.submit(Record(tmp_path / "run.rrd"))
    wait_for(lambda: recorder.path is not None)
    (tmp_path / "go").touch()
    wait_for(lambda: row_count(engine) == 60)
    source.put(readings(times[60:], values[60:]))
    wait_for(lambda: row_count(engine) == 120)
    engine.stop()
    recorder.stop()
    recorded = read_recording(tmp_path / "run.rrd")
    np.testing.assert_array_equal(recorded.events.value[:, 0], values)
    assert_same(refold(recorded), cold(times, values, "kf"))
    assert recorded.base is None


def test_who_chooses_another_filter_meanwhile_gets_that(started, tmp_path):
    engine, source = started(ukf=1, ckf=1)
    times, values = series(50)
    source.put(readings(times, values))
    wait_for(lambda: row_count(engine) == 50)
    engine.submit(SetEstimator("ukf"))
    wait_for(lambda: fresh_status(engine).awaited == "ukf")
    engine.submit(SetEstimator("sr-kf"))
    wait_for(lambda: engine.folded_with()[1] == "sr-kf")
    (tmp_path / "go").touch()
    wait_for(lambda: not fresh_status(engine).compiling)
    engine.submit(SetTuning("Q.rate", 0.5))
    wait_for(lambda: engine.folded_with()[0].get("Q.rate") == 0.5)
    assert engine.folded_with()[1] == "sr-kf" and fresh_status(engine).awaited is None


def test_what_is_asked_for_comes_first_and_the_rest_is_done_at_the_lowest_priority(shop, tmp_path):
    compile_queue, told = shop(ukf=1, ckf=1, pf=1), []
    compile_queue.start()
    wait_for(lambda: begun(tmp_path, Piece("ukf", 0)))
    compile_queue.request("pf", told.append)
    wait_for(lambda: begun(tmp_path, Piece("pf", 0)))
    assert begun(tmp_path, Piece("ckf", 0)) is None and not told
    states = compile_queue.states()
    assert states["ckf"] is None and states["pf"] >= 0.0 and states["ukf"] >= 0.0
    assert begun(tmp_path, Piece("pf", 0))[1] == os.nice(0)
    (tmp_path / "go").touch()
    wait_for(lambda: not compile_queue.states())
    assert told == ["pf"] and compile_queue.ready("ckf")
    for name in ("ukf", "ckf"):
        assert begun(tmp_path, Piece(name, 0))[1] == 19
    asked = []
    compile_queue.request("ukf", asked.append)
    assert asked == ["ukf"]


def test_what_fails_in_the_queue_is_left_to_who_uses_it(shop, tmp_path):
    compile_queue, told = shop(ukf=1, ckf=2), []
    paper(tmp_path, "fail", Piece("ukf", 0)).touch()
    compile_queue.start()
    compile_queue.request("ukf", told.append)
    compile_queue.request("ckf", told.append)
    wait_for(lambda: begun(tmp_path, Piece("ukf", 0)) and begun(tmp_path, Piece("ckf", 0)))
    paper(tmp_path, "go", Piece("ukf", 0)).touch()
    wait_for(lambda: told == ["ukf"])
    assert not paper(tmp_path, "done", Piece("ukf", 0)).exists()
    # As if the system had ended a process for want of memory.
    os.kill(begun(tmp_path, Piece("ckf", 0))[0], 9)
    (tmp_path / "go").touch()
    wait_for(lambda: told == ["ukf", "ckf"])


def killed(tmp_path, piece, *others):
    """The process that has begun a piece is ended from outside; it is none of the `others`."""
    wait_for(lambda: begun(tmp_path, piece) and begun(tmp_path, piece)[0] not in others)
    process = begun(tmp_path, piece)[0]
    os.kill(process, 9)
    return process


def test_what_was_ended_from_outside_is_begun_once_more_and_said(shop, tmp_path):
    compile_queue, told, said = shop(enkf=3), [], []
    compile_queue.report = said.append
    first, last = Piece("enkf", 0), Piece("enkf", 2)
    for place in (1, 2):
        paper(tmp_path, "go", Piece("enkf", place)).touch()
    compile_queue.start()
    compile_queue.request("enkf", told.append)
    process = killed(tmp_path, first)
    wait_for(lambda: len(said) == 1)
    assert "enkf was killed" in said[0] and said[0].endswith("compiled again")
    wait_for(lambda: begun(tmp_path, first)[0] != process and paper(tmp_path, "done", last).exists())
    assert not told and not compile_queue.ready("enkf")
    # Twice is no accident: who uses it compiles it.
    killed(tmp_path, first, process)
    wait_for(lambda: told == ["enkf"])
    assert len(said) == 2 and "compiled where it is used" in said[1] and not paper(tmp_path, "done", first).exists()


def test_the_engine_says_that_a_compiler_was_ended_and_folds_with_the_filter_all_the_same(started, tmp_path):
    engine, source = started(ukf=1)
    times, values = series(50)
    source.put(readings(times, values))
    wait_for(lambda: row_count(engine) == 50)
    engine.submit(SetEstimator("ukf"))
    killed(tmp_path, Piece("ukf", 0))
    wait_for(lambda: any("compiled ukf was killed" in text for text in notice_texts(engine)))
    assert engine.folded_with()[1] == "kf" and fresh_status(engine).awaited == "ukf"
    (tmp_path / "go").touch()
    wait_for(lambda: fresh_status(engine).revision == 1)
    assert_same(pull_all(engine).track, cold(times, values, "ukf"))


def test_what_a_source_needs_comes_first_and_is_waited_for_alone(shop, tmp_path):
    compile_queue = shop(**{LOOP: 1, "ukf": 4, FRAMES: 1})
    waiting = threading.Thread(target=compile_queue.wait, args=(FRAMES,), daemon=True)
    for name in ("ukf", FRAMES):
        compile_queue.request(name)
    waiting.start()
    compile_queue.start()
    wait_for(lambda: begun(tmp_path, Piece(FRAMES, 0)))
    assert list(compile_queue.states()) == ["ukf"]
    paper(tmp_path, "go", Piece(FRAMES, 0)).touch()
    wait_for(lambda: not waiting.is_alive())
    assert compile_queue.ready(FRAMES) and not compile_queue.ready("ukf")
    # Who waits when the compile_queue is closed is let go.
    waiting = threading.Thread(target=compile_queue.wait, args=("ukf",), daemon=True)
    waiting.start()
    compile_queue.stop()
    waiting.join(LIMIT_S)
    assert not waiting.is_alive()


def test_workers_that_began_before_the_queue_compile_in_it(tmp_path):
    worker, other = (Compiler(partial(slow_work, tmp_path), 0) for _ in range(2))
    piece = Piece("ukf", 0)
    pieces = {"ukf": [piece]}
    busy = CompileQueue(["ukf"], pieces=lambda name: pieces.get(name, []), is_done=lambda _: False, workers=[worker])
    busy.request("ukf")
    busy.start()
    wait_for(lambda: begun(tmp_path, piece))
    assert begun(tmp_path, piece)[0] == worker._process.pid
    busy.stop()
    idle = CompileQueue(["ukf"], pieces=lambda _: [], workers=[other])
    idle.start()
    assert all(item._process._process.returncode is not None for item in (worker, other))


def test_workers_begin_before_all_else_only_where_nothing_was_compiled(tmp_path, monkeypatch):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    begun_first = first_compilers()
    assert len(begun_first) == MAX_COMPILERS
    for worker in begun_first:
        worker.stop()
    cache_folder().mkdir(parents=True)
    assert first_compilers() == []


def test_nothing_is_left_running(shop, tmp_path):
    compile_queue = shop(ukf=1)
    compile_queue.start()
    wait_for(lambda: begun(tmp_path, Piece("ukf", 0)))
    process = begun(tmp_path, Piece("ukf", 0))[0]
    compile_queue.stop()
    wait_for(lambda: not Path(f"/proc/{process}").exists())  # `stop` waits for 2 s only


def test_the_pieces_are_what_a_fold_compiles():
    threaded()
    interpreted = [name for name, entry in ESTIMATORS.items() if entry.interpreted]
    log = measured(MODEL, MODEL.sensors[0].name, 0.0, 0.0)
    for name in ("kf", "ukf", interpreted[0]):
        assert Fold(name, MODEL, Tuning.of(MODEL), log).advance() == 1
        assert all(map(is_made, (*pieces_of(LOOP), *pieces_of(name))))
    assert [len(pieces_of(name)) for name in interpreted] == [2] * 4


MADE = """
from sources.pieces import is_made, make, pieces_of
before = [is_made(piece) for piece in pieces_of("kf")]
make(pieces_of("kf")[3])
print(before, [is_made(piece) for piece in pieces_of("kf")])
"""


def test_a_piece_that_one_process_makes_another_finds(tmp_path):
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["XDG_CACHE_HOME"] = str(tmp_path)
    said = [run_python(MADE, env=environment).stdout.strip() for _ in range(2)]
    none, one = [False] * 4, [False, False, False, True]
    assert said == [f"{none} {one}", f"{one} {one}"]
