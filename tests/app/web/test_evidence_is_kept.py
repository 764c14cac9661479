"""A biased sensor that is held out: its episode stays in the report, and its offset is shown."""

import re

import numpy as np
import pytest

from app.cli.open_twin import live_source
from app.engine.commands import Annotate, SetTuning
from app.engine.jobs import MAX_JOBS
from app.render.report import Reported, report
from app.render.track_file import rows_of_run
from app.twin.twin import load_twin
from app.web.running import OpenedTwin
from app.web.session import Session
from tests.app.cli.test_check import ParsedHtml
from tests.app.served import Client
from tests.app.web.page.browsed import running
from tests.waiting import wait_for

FAULT = "[{kind: bias, sensor: yoke, size: 6, start: 100}]"


@pytest.fixture(scope="module")
def session():
    with running("motor_joint", **{"source.duration": "200.0", "faults": FAULT}) as session:
        engine = session.engine
        for _ in range(MAX_JOBS):  # for which episodes do not wait
            engine.jobs.run("fit", lambda job: job.rest(3600.0))
        wait_for(lambda: any(item.subject == "yoke" for item in engine.episodes()))
        for revision, (key, value) in enumerate((("use.yoke", False), ("Q.winding", 0.02)), start=1):
            engine.submit(SetTuning(key, value))
            wait_for(lambda n=revision: engine._watchers.episode_log.summary.revision == n)
        yield session


def test_what_it_reads_is_said_beside_the_light_and_is_the_mean_of_its_last_innovations(session):
    state, text = wait_for(lambda: (found := session.engine.status().sensors["yoke"])[1] and found)
    taken = rows_of_run(session.engine)
    model, pull = session.engine.model, taken.pull
    innovations = pull.track.innovation[pull.events.of_sensor(model.sensor_names.index("yoke")), 0]
    innovations = innovations[np.isfinite(innovations)][-200:]
    assert state == "held out" and text.startswith("yoke, held out: ")
    said = float(re.search(r": ([\d.]+) °C above the prediction of the other sensors", text)[1])
    assert said == pytest.approx(float(np.mean(innovations)), rel=0.06)  # two figures are said


def test_the_report_has_the_episode_of_the_run_before_though_two_edits_came_since(session):
    assert not any(item.subject == "yoke" for item in session.engine.episodes())
    first = session.engine.revisions.find(0)
    assert first.track is None and any(item.subject == "yoke" for item in first.episodes)
    text = " ".join(ParsedHtml(Client(session.running.server).get("/api/report.html").text).text)
    assert "Episodes of earlier runs" in text and "0: as it began" in text
    for item in first.episodes:
        assert item.text in text
    assert "Yoke, held out: " in text


def test_the_report_of_the_first_run_has_nothing_from_before(session):
    taken = rows_of_run(session.engine)
    said = Reported(session.engine.twin, "ekf", taken.run.tuning, taken.pull.events, taken.pull.track, (), (), False)
    assert not [part for part in report(said) if "earlier runs" in part.title]


def test_notes_are_there_again_when_the_twin_is_started_again():
    """Another twin that runs meanwhile has none of them, nor has the same twin with another log."""

    def opening(name, seconds):
        twin = load_twin(name, overrides={"source.duration": seconds})
        return OpenedTwin(twin, live_source(twin, np.inf))

    session = Session(opening("motor_winding", "20"), page=None)
    session.start()
    try:
        wait_for(lambda: session.engine.status().finished)
        session.engine.submit(Annotate("fan off", 10.0))
        wait_for(lambda: session.engine.annotations.notes)
        before = session.engine.annotations.notes
        assert [(note.t, note.text) for note in before] == [(10 * 10**9, "fan off")]
        for name, seconds, kept in (
            ("lorenz63", "5", ()),
            ("motor_winding", "30", ()),
            ("motor_winding", "20", before),
        ):
            session.change(lambda name=name, seconds=seconds: session.prepared(opening(name, seconds)))
            assert session.engine.annotations.notes == kept
    finally:
        session.stop()


def test_errors_are_printed_while_a_twin_runs(capsys):
    twin = load_twin("motor_winding", overrides={"source": "{type: push}"})
    session = Session(OpenedTwin(twin, twin.open_source), page=None)
    session.start()
    for level in ("error", "warn"):
        session.engine.notices.say(f"{level}: the disk is full", level)
    session.stop()
    assert capsys.readouterr().err == "nisus: error: the disk is full\n"
