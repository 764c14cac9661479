"""The matrix of mistakes and its runner: figures against rows counted by hand, and mistakes whose outcome is known."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binom

from app.extensions.lab.stress.detection import (
    CHANCE,
    DETECTION,
    INVISIBLE,
    MISNAMED,
    NAMED,
    VISIBLE,
    Foretold,
    Oracle,
    make,
)
from app.extensions.lab.stress.matrix import matrix
from app.extensions.lab.stress.scenario import (
    Bench,
    Mistake,
    accused,
    first_word,
    green_share,
    quiet_of,
    recovery,
    said_at,
    without_truth,
)
from app.extensions.lab.stress.trials import Trials, all_trials
from app.twin.twin import load_twin
from estimators.diagnostics.episodes import Episode
from estimators.log import INPUT, READING, TICK, TRUTH
from estimators.models import MODELS
from estimators.track import ADVISORY, DEGRADED, DIVERGED, SUSPECT, TRACKING, WAITING
from estimators.tuning import Tuning
from sources.faults.kinds import problem
from tests.app.cli.test_main import documented
from tests.app.derive.test_noise import WHITE_NOISE
from tests.support import SECOND, as_log, log_of

MODEL = MODELS["motor_drive"]


def folded(health, alarms=None, channel=None):
    """A fold of a reading a second, whose health and alarms are written down here."""
    n = len(health)
    log = log_of(4, *((float(k), READING, [0.0], 0 if channel is None else channel[k]) for k in range(n)))
    track = SimpleNamespace(
        health=np.array(health, np.int8),
        alarms=np.zeros((n, 3), np.int32) if alarms is None else np.array(alarms, np.int32).reshape(n, -1),
        flags=np.zeros(n, np.int64),
    )
    return SimpleNamespace(log=log, events=log.events, track=track, n=n, model=MODEL)


W, T, S, D = WAITING, TRACKING, SUSPECT, DEGRADED


def test_words_shares_and_recovery_count_rows():
    fold = folded([W, W, T, T, S, S, T, D, T, T])
    assert first_word(fold, 0) == 4.0 and first_word(fold, 5 * SECOND) == 0.0 and first_word(fold, 8 * SECOND) is None
    assert green_share(fold, 2 * SECOND, 8 * SECOND) == 3 / 6
    assert recovery(fold, 6 * SECOND) == 2.0 and recovery(fold, 8 * SECOND) == 0.0
    assert recovery(folded([T, T, S, S]), SECOND) is None


def episode(subject, cause, start=0.0):
    return Episode(start, None, subject, cause, 0.0, 0.0, 0.0, "", "")


def test_an_episode_is_heard_of_in_the_first_row_that_alarms_after_it_began():
    channel = [0, 1, 2] * 3
    alarms = [[0, 0, 0]] * 4 + [[8, 0, 0], [4, 0, 0], [0, 0, 0], [8, 0, 0], [0, 0, 0]]
    fold = folded([T] * 4 + [S] * 5, alarms, channel)
    first, second, third = MODEL.sensor_names
    assert said_at(fold, episode(second, "shifted")) == 4 * SECOND
    assert said_at(fold, episode(third, "shifted", 2.0)) == 5 * SECOND
    assert said_at(fold, episode(second, "shifted", 4.5)) == 7 * SECOND
    assert said_at(fold, episode("twin", "diverged")) == 4 * SECOND


def test_the_matrix_can_be_made():
    """Each mistake of it is a fault that the source takes, or an entry of the tuning that can be set."""
    tuning = Tuning.of(MODEL)
    inputs = [(float(k), INPUT, [0.0, 10.0 + k, 100.0, 40.0, 20.0][: len(MODEL.inputs)]) for k in range(5)]
    readings = [(5.0, READING, [40.0], s) for s in range(len(MODEL.sensors))]
    events = log_of(MODEL.width, *inputs, *readings)
    found = matrix(MODEL, tuning, events.events, asset=True)
    names = [item.name for item in found]
    assert len(set(names)) == len(names) and len(found) > 60
    assert sum(item.parts == 2 for item in found) == 20
    for item in found:
        assert item.parts > 1 or (item.fault is None) != (not item.belief and not item.prior)
        for key, factor in item.belief.items():
            tuning.set(key, factor * tuning.get(key))
        for fault in item.fault(10.0, 20.0) if item.fault is not None else ():
            assert problem(fault, MODEL) is None and (fault.start, fault.end) == (10.0, 20.0)
    wanted = {"R x10", "Q /100", "yoke +5 σ", "tooth stuck", "all stuck", "winding silent", "winding spikes 1 %"}
    wanted |= {"yoke +5 σ from the start", "yoke 3 s late", "yoke drifts 1 σ in 100 s", "speed x1.1 from the start"}
    assert wanted <= {*names}
    # Twenty-five percent of an input that never changes, half of what another varies by; one that is zero has no size.
    assert "speed +25 rad/s" in names and "i_q +2 A" in names and not any(name.startswith("i_d +") for name in names)
    assert not any(item.of_asset for item in matrix(MODEL, tuning, events.events, asset=False))
    # Nothing is done to a sensor that says nothing, nor in its name.
    names = [item.name for item in found if item.parts == 1]
    mute = matrix(MODEL, tuning, log_of(MODEL.width, *inputs, *readings[1:]).events, asset=True)
    assert "winding stuck" in names and "winding and tooth swapped" in names and "clock of winding 1 s behind" in names
    assert {item.name for item in mute if item.parts == 1} == {
        name for name in names if "winding" not in name or name.startswith(("capacity_", "winding_", "prior of "))
    } | {"tooth and yoke swapped", "tooth and yoke swapped from the start"}


def test_subject_and_cause():
    mistake = Mistake("", frozenset({"shifted"}), frozenset({"yoke"}))
    assert mistake.right_cause(episode("tooth", "shifted")) and not mistake.right_subject("tooth")
    assert mistake.right_subject("yoke.top") and mistake.right_subject("yoke")
    assert not mistake.right_subject("input yoke") and not mistake.right_cause(episode("yoke", "wide"))


def test_a_log_without_truth_keeps_its_rows():
    events = log_of(2, (0, TICK, []), (1, TRUTH, [5.0, 6.0]), (1, READING, [1.0]), (2, TRUTH, [7.0], 1)).events
    log = as_log(without_truth(events))
    assert log.n == len(events) and not np.any(log.events.kind == TRUTH)
    np.testing.assert_array_equal(log.events.t, events.t)
    np.testing.assert_array_equal(log.events.kind == READING, events.kind == READING)
    np.testing.assert_array_equal(log.events.value[events.kind == READING], events.value[events.kind == READING])


@pytest.fixture(scope="module")
def bench():
    return Bench(load_twin("motor_winding"), 0, 240.0)


def chosen(bench, name):
    twin = bench.twin
    return next(item for item in matrix(twin.model, twin.tuning, bench.events, asset=True) if item.name == name)


def test_what_comes_late_within_the_horizon_changes_nothing(bench):
    trial = make(bench, chosen(bench, "all 0.5 s late"), "kf", Foretold(VISIBLE))
    # The twin ships without a gate, so the fold without one is the undisturbed one.
    assert trial.bare == trial.calm and trial.stale == 0
    assert (trial.word, trial.delay, trial.named, trial.green, trial.recovery) == (None, None, None, 1.0, 0.0)


def test_the_error_of_a_bias_is_what_a_linear_filter_makes_of_it(bench):
    """A Kalman filter without a gate is linear: its error under a bias b is that without it plus b times one response,
    so the mean square is a quadratic in b. Those at 0, 2 and 5 give that at 20, to rounding.
    """
    trials = {size: make(bench, chosen(bench, f"winding +{size} σ"), "kf", Foretold(VISIBLE)) for size in (2, 5, 20)}
    assert {(trial.start, trial.end) for trial in trials.values()} == {(80.0, 160.0)}
    sizes = np.array([0.0, 2.0, 5.0])
    square = (
        np.array([trials[2].calm["temperature"], trials[2].bare["temperature"], trials[5].bare["temperature"]]) ** 2
    )
    expected = np.sqrt(np.polyval(np.polyfit(sizes, square, 2), 20.0))
    assert trials[20].bare["temperature"] == pytest.approx(expected, rel=1e-9)
    assert trials[20].bare["temperature"] > 10 * trials[20].calm["temperature"]
    # With a gate it is refused for a while.
    assert trials[20].error["temperature"] < 0.9 * trials[20].bare["temperature"]
    assert trials[20].coverage["temperature"] < 0.2


def test_what_must_be_seen_is_seen_and_named(bench):
    """Bands that are too wide are told in an advisory, which is green."""
    for name, named, green in (
        ("R x100", "winding wide", 1.0),
        ("winding stuck", "winding stuck", 0.6),
        ("all silent", "twin stale", 0.6),
    ):
        trial = make(bench, chosen(bench, name), "kf", Foretold(VISIBLE))
        assert trial.named == named and trial.cause_right and trial.subject_right
        assert 0.0 <= trial.word <= trial.delay < 40.0 and trial.green <= green and trial.early == 0


def test_the_sensor_is_the_one_that_a_user_is_told_to_look_at(data):
    """A heading that is off lets the position be refused, and the heading is to blame; as soon as that is asked."""
    data("can_css_imu100_obd2", "session_00000164")
    bench = Bench(load_twin("road_car"), 0, 600.0)
    trial = make(bench, chosen(bench, "gnss_heading +20 σ"), "ekf", Foretold(VISIBLE))
    assert trial.named.startswith("gnss_position.") and trial.accused == "gnss_heading"
    assert trial.subject_right and trial.cause_right and trial.outcome == NAMED
    # Before anything has been seen, and of a cause that leaves nothing open, it is who the episode is of.
    begun, _ = bench.span(chosen(bench, "gnss_heading +20 σ"))
    fold = bench.fold(chosen(bench, "gnss_heading +20 σ"), "ekf", bench.twin.tuning.gate).fold
    early = episode("gnss_position.east", "refused", begun * 1e-9)
    assert accused(fold, early, begun) == ("gnss_position.east",)
    assert accused(fold, early._replace(cause="stuck"), begun + 100 * SECOND) == ("gnss_position.east",)
    assert accused(fold, early, begun + 100 * SECOND)[0] == "gnss_heading"


def test_a_change_of_the_asset_is_made_in_the_asset():
    twin = load_twin("motor_can")
    bench = Bench(twin, 1, 30.0)
    mistake = chosen(bench, "winding_tooth of the asset +30 %")
    damaged = bench._damaged(mistake)
    for events in (bench.events, damaged):
        assert events.t.max() <= 30 * SECOND
    assert len(damaged) == len(bench.events)
    same = np.all((damaged.value == bench.events.value) | np.isnan(damaged.value), axis=1)
    assert np.all(same[damaged.t < 10 * SECOND]) and not np.any(
        same[(damaged.kind == TRUTH) & (damaged.t > 10 * SECOND)]
    )
    assert not np.array_equal(Bench(twin, 2, 30.0).events.value, bench.events.value, equal_nan=True)


def test_the_command_prints_a_table_or_json(nisus):
    given = ["stress", "motor_winding", "--only", "winding stuck", "R x100", "--seeds", "2", "--duration", "120"]
    out = nisus(*given, "--jobs", 1).out
    assert "winding stuck" in out and "2/2" in out and "0 rows wrong and green" in out
    rows = nisus(*given, "--json", "--jobs", 1).json
    assert nisus(*given, "--json", "--jobs", 2).json == rows
    assert set(rows[0]) <= documented()["stress"]
    made = ["R x100", "winding stuck", "winding stuck from the start"]
    assert [(row["mistake"], row["seed"]) for row in rows] == [(name, seed) for seed in (0, 1) for name in made]
    assert "Wrong, undetected and not listed\n  none" in out
    assert "Q /100" in nisus("stress", "motor_winding", "--list", "--duration", 60).out.splitlines()


def test_what_is_invisible_is_exactly_what_is_not_found():
    """Foretold before they are made; of 95 % each, at most so many go otherwise as chance explains (1 in 1000)."""
    twin, names = load_twin("motor_can"), ("σ", "i_d", "coolant", "of the asset", "R x100", "silent")
    outcomes = {VISIBLE: [], INVISIBLE: [], CHANCE: []}
    bench, oracle = Bench(twin, 3, 120.0), Oracle(twin, 120.0)
    for mistake in matrix(twin.model, twin.tuning, bench.events, asset=True):
        if any(text in mistake.name for text in names):
            foretold = oracle.foretell(bench, mistake, "ekf")
            trial = make(bench, mistake, "ekf", foretold)
            outcomes[foretold.verdict].append(trial.outcome in (NAMED, MISNAMED))
    seen, hidden = np.array(outcomes[VISIBLE]), np.array(outcomes[INVISIBLE])
    assert seen.size >= 20 and hidden.size >= 20
    for wrong in (~seen, hidden):
        assert wrong.sum() <= binom.ppf(0.999, wrong.size, 1.0 - DETECTION)


def test_an_input_that_moves_nothing_is_invisible_and_a_large_bias_is_not():
    twin = load_twin("motor_can")
    bench, oracle = Bench(twin, 0, 60.0), Oracle(twin, 60.0)
    mistakes = {item.name: item for item in matrix(twin.model, twin.tuning, bench.events, asset=True)}
    assert oracle.foretell(bench, mistakes["magnet_ambient of the asset +30 %"], "ekf").verdict == INVISIBLE
    # What nisus check lists beforehand is the same, and so is what it does not list.
    assert oracle.listed(bench, mistakes["magnet_ambient believed +30 %"], "ekf")
    assert not oracle.listed(bench, mistakes["tooth +20 σ from the start"], "ekf")
    few, many = (oracle.foretell(bench, mistakes[f"tooth +{n} σ"], "ekf") for n in (5, 20))
    assert few.verdict == many.verdict == VISIBLE
    # One constant that is seen from the same size on, whatever was tried: the filter is linear in it.
    assert 5.0 * few.multiple == pytest.approx(20.0 * many.multiple, rel=0.02)


def test_what_was_said_without_the_mistake_is_not_counted_for_it():
    calm, wrong = folded([T, S, S, T, T, T]), folded([T, S, S, T, S, S])
    assert first_word(wrong, 0) == 1.0 and first_word(wrong, 0, calm) == 4.0 and first_word(calm, 0, calm) is None
    # Of one time there may be several rows: who was silent is, in the first of them, until the reading comes.
    calm = folded([T, T, S, T, T])
    calm.log.t[3] = calm.log.t[2]
    assert first_word(calm, 0) == 2.0 and first_word(calm, 0, calm) is None


def test_a_grade_worse_than_without_the_mistake_is_counted_for_it():
    calm = folded([T, ADVISORY, ADVISORY, ADVISORY, S, ADVISORY])
    wrong = folded([T, ADVISORY, ADVISORY, S, S, DIVERGED])
    tells = quiet_of(Mistake("bias", frozenset({"shifted"})))
    assert first_word(wrong, 0, calm, tells) == 3.0  # suspect where only an advisory was
    assert first_word(wrong, 4 * SECOND, calm, tells) == 1.0  # not for what was suspect anyway, but for a lost estimate
    assert first_word(calm, 0, wrong, tells) is None
    harmless = quiet_of(Mistake("late", frozenset()))
    assert first_word(folded([T, T, T, ADVISORY, S]), 0, folded([T] * 5), harmless) == 4.0


def test_a_wrong_belief_over_a_recording_is_foretold_by_what_follows(data):
    """Begun anew every 300 s of it: a tenth of R is found each time, a tenth of Q hardly ever."""
    data("battery_panasonic_18650pf", "25degC_US06.mat")
    # Without the errors that last, and with what was normal then.
    overrides = WHITE_NOISE | {
        "baseline": """{voltage: {bias: 0.002, scale: 0.372, correlation: 0.609,
          reached: {narrow: 295.4, wide: 3524.3, shifted up: 211.4, shifted down: 229.5, correlated: 997.6,
          alternating: 522.3, spiky: 2106.5, stuck: 237.6}},
          temperature: {bias: 0.008, scale: 1.004, correlation: 0.683,
          reached: {narrow: 292.2, wide: 1029.4, shifted up: 24.7, shifted down: 16.6, correlated: 326.2,
          alternating: 161.9, spiky: 2302.4, stuck: 15.1}}}""",
    }
    twin = load_twin("battery_panasonic", overrides=overrides)
    bench, oracle = Bench(twin, 0, 300.0), Oracle(twin, 300.0)
    told = {name: oracle.foretell(bench, chosen(bench, name), "ekf").verdict for name in ("R /10", "Q /10")}
    assert told == {"R /10": VISIBLE, "Q /10": INVISIBLE}


def test_trials_of_a_cluster_are_those_of_this_process():
    twin = load_twin("motor_winding")
    chosen = [item for item in enumerate(Trials(twin, 60.0).mistakes) if item[1].name in ("R x10", "winding +5 σ")]
    given = "motor_winding", {}, (), 60.0, chosen, ("kf", "ukf"), 1
    here = dict(all_trials(*given, jobs=1))
    assert len(here) == 4 and {trial.estimator for trial in here.values()} == {"kf", "ukf"}
    # As text, in which a number that is none is itself.
    assert repr(sorted(all_trials(*given, cluster="local:2"))) == repr(sorted(here.items()))
