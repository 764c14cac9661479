"""Dual estimation of a running twin: proposed, adopted, dismissed, said; the engine goes on whatever comes of it."""

import shutil
import signal
from functools import partial

import numpy as np
import pytest

from app.cli.main import main
from app.cli.open_twin import live_source, recorded_twin
from app.derive.refits import ADOPTED, BROKEN, DISMISSED, FITTING, NOTHING, OFFERED, OUTDATED, Refits
from app.engine.commands import Record, SetTuning
from app.record.reader import read_recording
from app.twin.twin import load_twin
from app.web.running import OpenedTwin
from app.web.session import Session
from config.loader import TWINS
from config.tunings import load_version, version_files
from estimators.errors import ConfigError
from tests.app.scripted import Replayed, Stepped, readings, row_count
from tests.waiting import wait_for

WINDOW, EVERY, RATE = 60, 30, 10
SECTION = f"{{entries: [R.winding], every: {EVERY} s, window: {WINDOW} s, adopt: %s}}"


class Refitted(Stepped):
    """A winding that stays at 40 °C, measured with the noise that a test asks for, and the fits of its twin."""

    def __init__(self, folder, adopt="by hand"):
        path = folder / "winding.yaml"
        shutil.copy(TWINS / "motor_winding.yaml", path)
        self.twin = load_twin(path, overrides={"refit": SECTION % adopt, "Q.rate": "1e-6", "Q.temperature": "1e-6"})
        super().__init__(of=self.twin, source=Replayed())
        self.refits = Refits(self.engine)
        self.rng, self.t = np.random.default_rng(11), 0

    def measure(self, seconds, std):
        n = seconds * RATE
        times = (self.t + np.arange(1, n + 1)) / RATE
        self.t += n
        self.put(readings(times, 40.0 + std * self.rng.normal(size=n)))

    def look(self):
        """To the end of a fit, if one is due; the state of the last one."""
        self.refits.update()
        self.engine.settle()
        if self.refits.known and self.refits.known[-1].state == FITTING:
            self.refits.update()
            self.engine.settle()
        return self.refits.known[-1].state if self.refits.known else None

    def accept(self, number):
        name = self.refits.accept(number)
        self.engine.settle()
        assert self.engine.folded_with()[0].name == name
        return name

    def refit_notices(self):
        return [text for text in self.notices() if text.startswith("refit")]


@pytest.fixture
def begin(tmp_path):
    return partial(Refitted, tmp_path)


@pytest.fixture
def offered(begin):
    """A twin whose first fit, of too small a noise, is proposed."""
    twin = begin()
    twin.measure(WINDOW + 1, 5.0)
    assert twin.look() == OFFERED and twin.refits.open.number == 1
    return twin


def test_nothing_is_fitted_before_a_whole_window_and_then_at_set_times(begin):
    twin = begin()
    assert twin.look() is None
    twin.measure(WINDOW - 1, 2.0)
    assert twin.look() is None
    twin.measure(2, 2.0)
    assert twin.look() is not None
    (first,) = twin.refits.known
    # To the event: the last 60 s of the log, though a fold's snapshots lie elsewhere.
    assert first.attempt.events == WINDOW * RATE + 1 and first.end - first.start == WINDOW * 10**9
    assert twin.refits.due == first.end + EVERY * 10**9
    twin.measure(EVERY - 1, 2.0)
    twin.look()
    assert len(twin.refits.known) == 1
    twin.measure(1, 2.0)
    twin.look()
    assert [item.number for item in twin.refits.known] == [1, 2]


def test_what_does_not_win_is_not_proposed_and_is_said(begin):
    twin = begin()
    # 2 °C, as the YAML says.
    twin.measure(WINDOW + 1, 2.0)
    assert twin.look() == NOTHING and twin.refits.open is None
    (line,) = twin.refit_notices()
    assert line.startswith("refit 1: nothing better: no better prediction of the held-out blocks")
    assert not version_files(twin.twin.path) and twin.engine.tuning is twin.engine.twin.tuning
    with pytest.raises(ConfigError, match="refit 1: it is nothing better; only a proposed fit"):
        twin.refits.accept(1)


def test_adopted_by_hand_a_version_with_its_evidence_goes_on(offered):
    # Nothing was put in, and nothing written.
    assert offered.engine.revisions.runs[-1].number == 0 and not version_files(offered.twin.path)
    assert offered.accept(1) == "refit-1"
    version = load_version(version_files(offered.twin.path)["refit-1"])
    (line,) = offered.refits.known[0].attempt.fitted.lines
    assert offered.engine.tuning.get("R.winding") == line.after and line.low < 25.0 < line.high
    evidence = version.head.evidence
    moved = evidence.entries["R.winding"]
    assert (moved.before, moved.after) == (4.0, line.after) and moved.low < 25.0 < moved.high and moved.sigma > 10.0
    assert evidence.gain > 2.0 * evidence.error > 0.0
    assert version.head.scores["log_likelihood"] > evidence.before["log_likelihood"]
    assert "by hand" in version.head.note and version.head.fitted_on[0].startswith("601 events over 60 s, to 61 s")
    assert [text.split(": ")[:2] for text in offered.refit_notices()] == [
        ["refit 1", "proposed"],
        ["refit 1", "adopted by hand as tuning version refit-1"],
    ]
    assert offered.engine.revisions.runs[-1].why == "refit 1, version refit-1"
    # The next one starts from there, and finds nothing to mend.
    offered.measure(EVERY, 5.0)
    assert offered.look() == NOTHING and [item.state for item in offered.refits.known] == [ADOPTED, NOTHING]


def test_dismissed_it_does_not_come_again_until_the_data_say_something_else(offered):
    offered.refits.dismiss(1)
    assert offered.refits.open is None and offered.engine.revisions.runs[-1].number == 0
    with pytest.raises(ConfigError, match="refit 1: it is dismissed; only a proposed fit"):
        offered.refits.accept(1)
    for _ in range(2):
        offered.measure(EVERY, 5.0)
        assert offered.look() == DISMISSED and offered.refits.open is None
    assert "the same result was dismissed before" in offered.refit_notices()[-1]
    offered.measure(WINDOW, 10.0)
    assert offered.look() == OFFERED and offered.refits.open.number == 4


def test_adopted_by_rule_is_said_too(begin, tmp_path):
    twin = begin(adopt="if better")
    twin.measure(WINDOW + 1, 5.0)
    assert twin.look() == ADOPTED and twin.refits.known[0].name == "refit-1"
    assert twin.refit_notices()[-1].startswith("refit 1: adopted by rule as tuning version refit-1: R.winding 4 → ")
    twin.measure(WINDOW, 12.0)
    assert twin.look() == ADOPTED and twin.refits.known[-1].name == "refit-2"
    assert set(version_files(twin.twin.path)) == {"refit-1", "refit-2"}


def test_what_cannot_be_kept_waits_and_is_said(begin, tmp_path):
    (tmp_path / "winding.tunings").write_text("no folder")
    twin = begin(adopt="if better")
    twin.measure(WINDOW + 1, 5.0)
    assert twin.look() == OFFERED and twin.engine.revisions.runs[-1].number == 0
    assert "refit 1: not adopted: " in twin.refit_notices()[-1]
    (tmp_path / "winding.tunings").unlink()
    assert twin.accept(1) == "refit-1"


def test_a_proposal_holds_for_the_tuning_that_it_was_fitted_from(offered):
    offered.submit(SetTuning("R.winding", 20.0))
    with pytest.raises(ConfigError, match="refit 1: it is outdated"):
        offered.refits.accept(1)
    assert "another tuning runs by now" in offered.refit_notices()[-1]
    assert not version_files(offered.twin.path) and offered.engine.tuning.get("R.winding") == 20.0


def test_a_newer_proposal_takes_the_place_of_the_older(offered):
    offered.measure(WINDOW, 9.0)
    assert offered.look() == OFFERED
    assert [item.state for item in offered.refits.known] == [OUTDATED, OFFERED] and offered.refits.open.number == 2


def test_the_engine_goes_on_if_a_fit_fails(begin, monkeypatch):
    def broken(*args, **kwargs):
        raise ArithmeticError("no such luck")

    twin = begin()
    twin.measure(WINDOW + 1, 5.0)
    with monkeypatch.context() as patch:
        patch.setattr("estimators.fit.fit.fit", broken)
        assert twin.look() == BROKEN
    assert twin.refit_notices() == ["refit 1: failed: ArithmeticError: no such luck"]
    assert twin.engine.notices.since(0)[-1].level == "warn"
    twin.measure(EVERY, 5.0)
    assert twin.look() == OFFERED


def test_events_are_folded_while_a_fit_is_under_way(begin):
    twin = begin()
    twin.measure(WINDOW + 1, 5.0)
    twin.refits.update()
    engine = twin.engine
    # Rows come, and the fit that is due meanwhile waits.
    engine._accept([readings([WINDOW + 2.0], [40.0])])
    assert row_count(engine) == (WINDOW + 1) * RATE + 1
    twin.refits.update()
    assert [item.state for item in twin.refits.known] == [FITTING]
    with pytest.raises(ConfigError, match="another one is under way"):
        twin.refits.now()
    engine.settle()
    twin.refits.update()
    assert twin.refits.known[-1].state == OFFERED


def test_a_source_that_begins_again_is_waited_for_anew(begin):
    twin = begin()
    twin.measure(WINDOW + 1, 2.0)
    twin.look()
    twin.source.restart()
    twin.t = 0
    twin.measure(WINDOW - 1, 2.0)
    twin.look()
    assert len(twin.refits.known) == 1
    twin.measure(2, 2.0)
    twin.look()
    assert len(twin.refits.known) == 2


def test_at_once_if_asked_and_not_without_a_section(begin):
    twin = begin()
    with pytest.raises(ConfigError, match="no reading has come yet"):
        twin.refits.now()
    twin.measure(20, 5.0)
    twin.refits.now()
    assert twin.look() == OFFERED and twin.refits.known[0].attempt.events == 20 * RATE
    object.__setattr__(twin.twin.config, "refit", None)
    assert twin.refits.section is None
    with pytest.raises(ConfigError, match="no `refit` section"):
        twin.refits.now()


def test_without_a_page_it_is_in_the_recording(tmp_path):
    """By rule, headless: what was adopted, and why, is what a review begins with."""
    path, recording = tmp_path / "winding.yaml", tmp_path / "run.rrd"
    shutil.copy(TWINS / "motor_winding.yaml", path)
    section = "{entries: [R.winding], every: 10 min, window: 10 min, adopt: if better}"
    twin = load_twin(path, overrides={"refit": section, "R.winding": "100", "source.duration": "900"})
    session = Session(OpenedTwin(twin, live_source(twin, np.inf)), page=None)
    session.start()
    try:
        session.engine.submit(Record(recording))
        wait_for(lambda: session.engine.folded_with()[0].name == "refit-1")
        wait_for(lambda: session.engine.status().recording is not None)
    finally:
        session.stop()
    recorded = read_recording(recording)
    assert any(text.startswith("refit 1: adopted by rule as tuning version refit-1") for _, _, text in recorded.notices)
    again = recorded_twin(recorded)
    assert again.tuning.name == "refit-1" and again.version.head.evidence.gain > 0.0
    assert again.tuning.get("R.winding") == session.engine.tuning.get("R.winding") < 10.0


def test_without_a_page_it_is_said_on_the_terminal(tmp_path, capsys, monkeypatch):
    path = tmp_path / "winding.yaml"
    shutil.copy(TWINS / "motor_winding.yaml", path)
    section = "{entries: [R.winding], every: 10 s, window: 20 s, adopt: if better}"
    given = {"refit": section, "R.winding": "100", "source.duration": "2400"}
    sets = [word for key, value in given.items() for word in ("--set", f"{key}={value}")]
    become, seen = Refits._become, set()

    def heard(refits, number, state, *words, **more):
        become(refits, number, state, *words, **more)
        seen.add(state)
        if {ADOPTED, NOTHING} <= seen:
            seen.clear()
            signal.raise_signal(signal.SIGTERM)  # a fit takes as long as it takes, and the run would last 240 s

    monkeypatch.setattr(Refits, "_become", heard)
    assert main(["run", str(path), "--headless", "--speed", "10", *sets]) == 0
    said = capsys.readouterr().err
    assert "adopted by rule as tuning version refit-" in said and "nothing better" in said
