"""The state of each sensor: now, from what the bank has gathered, and along the track, row by row."""

import numpy as np

from estimators.diagnostics.detector_state import SENSOR_STATES, sensor_states, sensor_states_over_time
from estimators.diagnostics.detectors import ADVISORY_ALARM, NARROW
from estimators.diagnostics.episodes import episodes
from estimators.diagnostics.health import HealthPolicy
from estimators.fold import Fold
from estimators.interface.table import table_of
from estimators.log import READING, Events, Log
from estimators.track import USED, Track
from tests.models import level_model
from tests.support import SECOND
from tests.support import folded as advanced

POLICY = HealthPolicy(stale_after=60.0)


MODEL = level_model(dict.fromkeys(("one", "two", "three"), 1.0), 1e-6, linear=True)


def log_until(end: int, silent_from: int) -> Log:
    """Ticks at each second; gauge one reads noise, two repeats itself from 100 s on, three falls silent."""
    rng = np.random.default_rng(11)
    log = Log.of(MODEL)
    k = np.arange(float(end))
    one, two, three = rng.normal(size=(3, end))
    log.add("one", k + 0.1, one)
    log.add("two", k + 0.2, np.where(k < 100, two, 0.25))
    log.add("three", k[:silent_from] + 0.3, three[:silent_from])
    log.add_ticks(k + 0.4)
    return log


def folded(end: int, silent_from: int) -> Fold:
    return advanced("kf", MODEL, log_until(end, silent_from), policy=POLICY)


def states(fold: Fold, used=(True, True, True)) -> list[str]:
    now = int(fold.log.t[fold.n - 1]) * 1e-9
    return list(sensor_states(MODEL, np.array(used), fold.evidence, now, POLICY).values())


def test_each_sensor_has_a_state_of_its_own():
    assert states(folded(0, 0)) == ["waiting"] * 3
    assert states(folded(90, 200)) == ["tracking"] * 3
    assert states(folded(90, 0)) == ["tracking", "tracking", "waiting"]
    # Two has repeated itself 50 times; three is silent for 20 s, then for more than the 60 s of the policy.
    assert states(folded(150, 130)) == ["tracking", "degraded", "degraded"]
    assert states(folded(230, 130)) == ["tracking", "degraded", "stale"]
    assert states(folded(230, 130), (False, True, True)) == ["held out", "degraded", "stale"]


def test_along_the_track_it_changes_where_the_episodes_begin():
    fold = folded(180, 130)
    track, events = fold.track, fold.log.events
    of = {episode.subject: episode for episode in episodes(fold)}
    for s, name, after in ((1, "two", 100), (2, "three", 130)):
        rows, codes = sensor_states_over_time(events, track, s)
        words = [SENSOR_STATES[code] for code in codes]
        change = words.index("degraded")
        assert set(words[:change]) == {"tracking"} and set(words[change:]) == {"degraded"}
        # Told after the cause: some repetitions, or six periods.
        assert after < events.t[rows[change]] / SECOND < after + 30
        assert of[name].cause in ("stuck", "silent") and of[name].start < events.t[rows[change]] / SECOND
    rows, codes = sensor_states_over_time(events, track, 0)
    assert {SENSOR_STATES[code] for code in codes} == {"tracking"} and rows.size == 180


def test_a_sensor_is_advisory_while_all_of_its_rows_in_alarm_are():
    track, zero = Track.allocate(2, 1, 0, 2), np.zeros(2, np.int32)
    track.verdict[:], track.flags[:] = USED, 0
    track.alarms[:] = [[NARROW | ADVISORY_ALARM, 0], [NARROW | ADVISORY_ALARM, NARROW]]
    events = Events(zero, zero, np.full(2, READING), zero, np.zeros((2, 2)))
    assert [SENSOR_STATES[code] for code in sensor_states_over_time(events, track, 0)[1]] == ["advisory", "suspect"]


def test_the_table_has_alarms_and_flags_in_words():
    fold = folded(180, 130)
    table = table_of(MODEL, fold.log.events, fold.track)
    flags, alarms = table["flags"].to_pylist(), table["alarms"].to_pylist()
    assert [flag == "three silent" for flag in flags] == [bool(mask & 4) for mask in fold.track.flags]
    assert set(flags) == {None, "three silent"}
    assert [bool(words) for words in alarms] == [bool(mask) for mask in fold.track.alarms.any(axis=1)]
    stuck = [k for k, words in enumerate(alarms) if words and "stuck" in words.split(", ")]
    assert set(fold.log.channel[stuck]) == {1} and fold.log.t[stuck[0]] > 100 * SECOND
