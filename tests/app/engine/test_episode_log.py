"""The episode log: whatever order and pieces, its episodes are those of one fold of the log, and each is said once."""

from dataclasses import replace

import numpy as np
import pytest

from app.engine import commands
from app.engine.engine import Engine
from app.engine.episode_log import EpisodeLog
from app.leading import leading
from estimators import Input
from estimators.diagnostics.episodes import Episode, episodes
from estimators.track import GATED, HEALTH_NAMES, Track
from tests.app.scripted import MODEL, Replayed, Scripted, Stepped, notice_texts, readings, twin
from tests.cases import cases
from tests.models import level_model
from tests.support import as_log, folded

N = 1800
"""Readings, one a second: twice as noisy from the 300th to the 500th, stuck from the 1600th on."""


@pytest.fixture(scope="module")
def asset():
    rng = np.random.default_rng(7)
    t = 1.0 + np.arange(N)
    # As the model has it: an asset that stands still is one for which Q is too large, and that is found too.
    rate, wander = (rng.normal(0, np.sqrt(noise.variance), N) for noise in reversed(MODEL.noises))
    truth = 40.0 + np.cumsum(wander + np.cumsum(rate))
    noise = rng.normal(0, np.sqrt(MODEL.sensors[0].rows[0].variance), N)
    noise[300:500] *= 2.0
    y = truth + noise
    y[1600:] = y[1600]
    return t, y


@pytest.fixture
def engine():
    """One whose thread does not run: the tests hand it batches, and let the episode log look."""
    return Engine(twin(horizon=1000.0), lambda report: Scripted())


def whole(engine):
    """The episodes of one fold over the engine's log."""
    log = as_log(engine._log.events)
    fold = folded("kf", MODEL, log, engine.tuning, pairs=engine.pairs, policy=engine.policy)
    return episodes(fold)


def part(asset, chosen):
    """Those of its readings."""
    return readings(*(column[chosen] for column in asset))


def watch(engine):
    """Let the episode log look, as its job does."""
    engine._watchers.episode_log.update()


def same(found, expected):
    assert [e._replace(low=0, high=0) for e in found] == [e._replace(low=0, high=0) for e in expected]
    for column in ("low", "high"):
        np.testing.assert_array_equal([getattr(e, column) for e in found], [getattr(e, column) for e in expected])


@pytest.mark.parametrize("piece", [1, 7, 250, N])
def test_in_pieces_it_is_what_one_fold_says(engine, asset, piece):
    for start in range(0, N, piece):
        engine._accept([part(asset, slice(start, start + piece))])
        if piece > 1 or start % 5 == 0:
            watch(engine)
    watch(engine)
    expected = whole(engine)
    assert expected[0].end is not None and {"narrow", "stuck"} <= {episode.cause for episode in expected}
    same(engine.episodes(), expected)


def test_readings_that_come_late_take_rows_back(engine, asset):
    late = np.arange(280, 520, 3)
    prompt = np.setdiff1d(np.arange(600), late)
    for chosen in np.array_split(prompt, 12):
        engine._accept([part(asset, chosen)])
        watch(engine)
    before = engine.episodes()
    for chosen in np.array_split(late[::-1], 5):
        engine._accept([part(asset, chosen)])
        watch(engine)
    same(engine.episodes(), whole(engine))
    assert before != engine.episodes()
    assert sum("too narrow" in text for text in notice_texts(engine)) == 1


def test_each_is_said_once_when_it_begins_and_when_it_is_over(engine, asset):
    t, y = asset
    lasted, grades = False, []
    for start in range(0, 1580, 8):
        engine._accept([part(asset, slice(start, start + 8))])
        watch(engine)
        status = engine.status()
        engine._status = (-np.inf, status)
        if status.episodes_open:
            lasted = True
        if 330 <= start < 480:
            assert status.cause.startswith("bands of winding are too narrow")
            assert status.sensors["winding"][1] == status.cause
            grades.append(status.sensors["winding"][0])
    # An advisory until the share of measurements outside their bands is known to exceed a tenth.
    assert grades == sorted(grades) and set(grades) == {"advisory", "suspect"}
    (first,) = [line for line in engine.notices.since(0) if "too narrow" in line.text]
    assert first.text.startswith("health: advisory: bands of winding") and first.level == "info"
    narrow = engine.episodes()[0]
    # The test of variance 2.5 needs h = 14.4 nats. A reading of variance 4 gives it 0.3 e² - 0.46 of them, with a mean
    # of 0.74 and a deviation of 0.3 · 4 √2 = 1.7, so n readings suffice with 95 % where 0.74 n - 1.64 · 1.7 √n = 14.4.
    assert first.t == engine._log.t[np.flatnonzero(engine._fold.track.alarms.any(axis=1))[0]]
    assert 0 <= first.t * 1e-9 - narrow.start < 45
    assert sum(text.startswith("winding: no longer") for text in notice_texts(engine)) == 1
    assert lasted and engine.status().episodes_open == 0 and engine.status().cause == ""
    assert engine.status().sensors == {"winding": ("tracking", "")}


def test_what_began_before_the_rows_that_are_kept_is_carried_on(engine, asset):
    """200 noisy readings, and at most 128 rows kept: the end falls where the beginning is forgotten."""
    episode_log, starts = EpisodeLog(engine, max_rows=128), set()
    for start in range(0, 1580, 10):
        engine._accept([part(asset, slice(start, start + 10))])
        episode_log.update()
        if episode_log.tracker.first > 337:
            starts.add(episode_log.summary.episodes[0].start)
    (expected,), (found,) = whole(engine), episode_log.summary.episodes
    # Its onset was sought at the first alarm, less than 64 readings later (see above), when at least 64 were kept. Of
    # those that are forgotten since then the sums are left, on which the likelihood of each end depends.
    assert found.subject == expected.subject and starts == {found.start}
    assert (found.start, found.end) == (expected.start, expected.end)
    assert episode_log.tracker.n <= 128


@pytest.mark.parametrize("rows", [65_536, 512], ids=["all rows", "few rows"])
def test_what_lasts_hides_no_later_loss(engine, rows):
    """A tenth of the noise that is believed, and from the 600th reading on 500 times the same; also where the beginning
    of both is forgotten.
    """
    rng = np.random.default_rng(3)
    t = 1.0 + np.arange(N)
    y = 40.0 + rng.normal(0.0, 0.1 * np.sqrt(MODEL.sensors[0].rows[0].variance), N)
    y[600:1100] = y[600]
    episode_log = EpisodeLog(engine, max_rows=rows)
    for start in range(0, N, 20):
        engine._accept([part((t, y), slice(start, start + 20))])
        episode_log.update()
        if 800 <= start < 1000:
            lasting = {entry.key[0]: entry.episode for entry in episode_log.summary.lasting}
            assert {kind: each.cause for kind, each in lasting.items()} == {"sensor": "wide", "lost": "stuck"}
            assert lasting["lost"].start == pytest.approx(601.0)
            folded, found = episode_log.tracker.track, [*lasting.values()]
            assert leading(MODEL, found, {"winding": "degraded"}, folded, np.zeros(0))[0][0].cause == "stuck"
    wide, stuck = episode_log.summary.episodes
    expected = whole(engine)
    assert [(each.cause, each.start) for each in (wide, stuck)] == [(each.cause, each.start) for each in expected]
    assert wide.end is None and stuck.end == pytest.approx(1100.0) == expected[1].end
    assert episode_log.tracker.n <= rows
    assert sum(text.startswith("winding: no longer stuck") for text in notice_texts(engine)) == 1


def test_another_revision_begins_anew_and_says_nothing_twice(asset):
    stepped = Stepped()
    engine = stepped.engine
    stepped.put(part(asset, slice(400)))
    watch(engine)
    assert engine.episodes()[-1].end is None and sum("too narrow" in text for text in notice_texts(engine)) == 1
    # As narrow as before, or nearly.
    stepped.submit(commands.SetTuning("R.winding", 3.0))
    watch(engine)
    same(engine.episodes(), whole(engine))
    assert sum("too narrow" in text for text in notice_texts(engine)) == 1
    # Wide bands explain the readings: what was open has gone, and is not carried on.
    stepped.submit(commands.SetTuning("R.winding", 100.0))
    watch(engine)
    assert all(episode.cause != "narrow" for episode in engine.episodes())
    same(engine.episodes(), whole(engine))


def test_a_source_that_begins_again_has_an_episode_log_of_its_own(asset):
    stepped = Stepped(source=Replayed())
    engine = stepped.engine
    for begun in (1, 2):
        stepped.put(part(asset, slice(400)))
        watch(engine)
        # What lasted in the life before is said again in this one.
        assert sum("too narrow" in text for text in notice_texts(engine)) == begun
        same(engine.episodes(), whole(engine))
        stepped.source.restart()


def test_a_refused_sensor_is_said_once_and_not_reading_by_reading(asset):
    made = twin()
    made.tuning = made.tuning.set("gate", 0.99)
    engine = Engine(made, lambda report: Scripted())
    t, y = asset
    moved = y.copy()
    moved[300:] += 100.0
    told, refused = [], 0
    for start in range(0, 600, 10):
        known = "winding" in engine._watchers.episode_log.summary.in_alarm
        lines = len(engine.notices.since(0))
        # As if each batch came a second after the one before.
        engine.notices._last.clear()
        engine._accept([readings(t[start : start + 10], moved[start : start + 10])])
        new = [line.text for line in engine.notices.since(lines)]
        if np.any(engine._fold.track.verdict[-10:] == GATED):
            refused += known
            told.append((known, any(text.startswith("winding: measurement rejected") for text in new)))
        watch(engine)
    assert refused > 3 and all(line != known for known, line in told)
    assert sum("is rejected by the gate" in text for text in notice_texts(engine)) == 1


@cases(__file__, "causes.csv")
def test_the_cause_is_that_of_an_episode_in_alarm_with_the_grade_of_the_twin(health, flags, states, lasting, cause):
    """Of a twin with two sensors, one of two rows, a state whose mean is 5, fitted up to 4, and an input of 1."""
    model = level_model({"a": 1.0, "b": {"x": 1.0, "y": 1.0}}, 1e-6)
    state = replace(model.states[0], fitted=(0.0, 4.0))
    model = replace(model, states=(state,), inputs=(Input("drive", "V", fitted=(0.0, 2.0)),))
    track = Track.allocate(1, 1, 0, 3)
    track.mean[:], track.std[:], track.health[:], track.flags[:] = 5.0, 0.1, HEALTH_NAMES.index(health), int(flags)
    of = dict(zip("ab", states.split(), strict=True))
    found = [
        Episode(float(start), None, subject, name, 1.0, 0.0, 2.0, "", f"{subject} {name}", grade)
        for start, (subject, name, grade) in enumerate(item.split("/") for item in lasting.split())
    ]
    assert leading(model, found, of, track, np.ones(1))[1] == cause


def test_rows_that_left_the_history_unseen_take_no_episode_along(engine, asset):
    longer = 1.0 + np.arange(9200), np.pad(asset[1], (0, 7400), "edge")
    engine.history, found = 2048, []
    for rows in np.split(np.arange(9200), [1700]):
        for chosen in np.array_split(rows, 15):
            engine._accept([part(longer, chosen)])
        watch(engine)
        found.append([each[:4] for each in engine.episodes() if each.cause in ("narrow", "stuck")])
    assert len(found[0]) == 2 and found[1] == found[0]
