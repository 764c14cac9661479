"""Who is most likely off, found beside a running twin."""

import numpy as np
import pytest

from app.live.fault_monitors import RootCause
from app.live.jobs import Job
from app.live.notices import Notices
from app.live.outputs import event_window
from estimators.diagnostics.episodes import Episode, episodes
from estimators.fold import Fold
from estimators.log import READING, Log
from estimators.models import MODELS
from estimators.tuning import Tuning
from sources.simulator import Simulator, constant_input, stepped_input
from tests.support import read_all

MODEL = MODELS["motor_drive"]


@pytest.fixture(scope="module")
def folded():
    """A minute and a half of a motor whose yoke reads 2 °C too high from a minute on."""
    inputs = {
        "i_q": stepped_input((0.0, 20.0), (60.0, 200.0)),
        "speed": constant_input(250.0),
        "coolant": constant_input(40.0),
    }
    log = Log.of(MODEL)
    log.extend(read_all(Simulator(MODEL, seed=2, step=0.1, duration=90.0, inputs=inputs)))
    wrong = (log.kind[: log.n] == READING) & (log.channel[: log.n] == MODEL.sensor_names.index("yoke"))
    log.value[: log.n][wrong & (log.t[: log.n] >= 60 * 10**9), 0] += 2.0
    fold = Fold("ekf", MODEL, Tuning.of(MODEL), log)
    fold.advance()
    return fold


def root_cause_of(fold, known, notices=None):
    said = notices or Notices(lambda: 0)
    return RootCause(lambda: known, lambda: event_window(fold, 0, 4000), said), said


def test_the_sensor_that_is_off_is_named_once_and_in_the_text(folded):
    (yoke,) = [episode for episode in episodes(folded) if (episode.subject, episode.cause) == ("yoke", "shifted")]
    cause, notices = root_cause_of(folded, [yoke])
    cause.update(Job("test"))
    cause.update(Job("test"))
    words = cause.fault_behind(yoke)
    assert words.startswith("sensor yoke +")
    assert cause.with_fault(yoke).text == f"{yoke.text}; most likely off: {words}"
    lines = [line.text for line in notices.since(0)]
    assert lines == [f"yoke: most likely off: {words}"]


def test_a_consequence_leads_to_the_sensor_that_is_behind_it(folded):
    """What tooth shows is explained best by yoke: its episode is the one to look at, while it lasts."""
    (yoke,) = [episode for episode in episodes(folded) if (episode.subject, episode.cause) == ("yoke", "shifted")]
    tooth = yoke._replace(subject="tooth", text="tooth reads low")
    known = [yoke, tooth]
    cause, _ = root_cause_of(folded, known)
    assert cause.primary(tooth) is tooth  # not yet asked
    cause.update(Job("test"))
    assert cause.primary(tooth) is yoke and cause.primary(yoke) is yoke
    known[0] = yoke._replace(end=80.0)
    assert cause.primary(tooth) is tooth


def test_what_is_over_or_no_riddle_is_left_alone(folded):
    over = Episode(60.0, 70.0, "yoke", "shifted", 1.0, 0.5, 1.5, "σ", "yoke reads high")
    stuck = Episode(60.0, None, "tooth", "stuck", 41.0, np.nan, np.nan, "°C", "tooth is stuck")
    cause, notices = root_cause_of(folded, [over, stuck])
    cause.update(Job("test"))
    assert not notices.since(0) and cause.with_fault(over) is over and cause.with_fault(stuck) is stuck


def test_an_episode_older_than_the_window_is_not_guessed(folded):
    old = Episode(60.0, None, "yoke", "shifted", 1.0, 0.5, 1.5, "σ", "yoke reads high")
    late = event_window(folded, 0, 4000)._replace(base=folded.base_at(0)[1]._replace(clock=70 * 10**9))
    cause = RootCause(lambda: [old], lambda: late, Notices(lambda: 0))
    cause.update(Job("test"))
    assert cause.fault_behind(old) == ""
