"""Episodes of one fault each, put into readings that were in order: who, what, from when to when, in words."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from estimators.diagnostics.detector_state import no_baseline
from estimators.diagnostics.detectors import BITS, CAUSES, IMPOVERISHED, NARROW, SHIFTED, SPIKY, STUCK, memory_flag
from estimators.diagnostics.episodes import JOINED, Episode, episode_json, episodes, found_in, judged_rows
from estimators.diagnostics.episodes.wording import SensorFacts
from estimators.diagnostics.health import HealthPolicy
from estimators.log import READING, RESET, Events, Log
from estimators.model.parts import Limits
from estimators.model.state_space import Input, Noise, State
from estimators.track import DIVERGED, GATED, TRACKING, USED, WAITING
from estimators.tuning import Tuning
from tests.cases import cases
from tests.models import level_model, unchanged
from tests.support import SECOND, as_log
from tests.support import folded as advanced

ROWS = 8


def walk(x, u, p, dt, out):
    out[0] = x[0] + dt * u[0]


MODEL = level_model(
    {"gauge": 0.04, "chain": {f"c{k}": 1.0 for k in range(ROWS)}},
    0.0025,
    states=(State("level", "m", mean=0.0, std=1.0, fitted=(-20.0, 20.0), limits=(-100.0, 100.0)),),
    inputs=(Input("feed", "m/s", fitted=(-1.0, 1.0)),),
    f=walk,
    linear=True,
)
LIMITED = replace(MODEL, sensors=(replace(MODEL.sensors[0], limits=Limits(range=((-100.0, 100.0),))), MODEL.sensors[1]))
POLICY = HealthPolicy(degraded_after=10.0, stale_after=40.0)
N, BEGIN, END = 1200, 400, 600


def noise(rng, n, phi):
    """AR(1) of unit variance."""
    z = rng.standard_normal(n)
    for k in range(1, n):
        z[k] = phi * z[k - 1] + np.sqrt(1.0 - phi**2) * z[k]
    return z


def folded(*, gauge=None, chain=None, skip=None, gate=None, truth=0.0, feed=0.0, expected=None, seed=0):
    """A reading of each sensor a second, exact until something is said of the seconds from BEGIN to END.

    `gauge` and `chain`: what these readings are instead, of the level (n,) and the noise in σ (n, rows); `skip`:
    sensors that say nothing; `truth`: how far off what is told is; `feed`: the input.
    """
    rng = np.random.default_rng(seed)
    level = np.cumsum(0.05 * rng.standard_normal(N))
    z, others = rng.standard_normal((N, 1)), rng.standard_normal((N, ROWS))
    within = slice(BEGIN, END)
    y = [level[:, None] + 0.2 * z, level[:, None] + others]
    for s, (change, noises) in enumerate(((gauge, z), (chain, others))):
        if change is not None:
            y[s][within] = change(level[within, None], noises[within], rng)
    t, off = np.arange(1.0, N + 1.0), (np.arange(N) >= BEGIN) & (np.arange(N) < END)
    log = Log.of(MODEL)
    log.add_inputs(t, feed=np.where(off, feed, 0.0))
    log.add_ticks(t)
    for s, sensor in enumerate(MODEL.sensor_names):
        kept = ~off | (skip is None or s not in skip)
        log.add(sensor, t[kept], y[s][kept])
    log.add_truth(t, level=level + np.where(off, truth, 0.0))
    tuning = Tuning.of(MODEL).set("gate", gate).set("gate.reopen", None)
    return advanced("kf", MODEL, log, tuning, policy=POLICY, expected=expected)


def spiked(x, z, rng):
    z = z.copy()
    z[::15] = 6.0 * rng.choice([-1.0, 1.0], z[::15].shape)
    return x + 0.2 * z


SENSORS: dict[str, dict] = {
    "shifted": {"gauge": lambda x, z, rng: x + 0.4 + 0.2 * z},
    "narrow": {"gauge": lambda x, z, rng: x + 0.6 * z},
    "wide": {"gauge": lambda x, z, rng: x + 0.04 * z},
    "correlated": {"gauge": lambda x, z, rng: x + 0.2 * noise(rng, len(x), 0.7)[:, None]},
    "alternating": {"gauge": lambda x, z, rng: x + 0.2 * noise(rng, len(x), -0.7)[:, None]},
    "spiky": {"gauge": spiked},
    "refused": {"gauge": lambda x, z, rng: x + 5.0 + 0.2 * z, "gate": 0.9999},
    "stuck": {"gauge": lambda x, z, rng: np.full_like(x, 0.125)},
    "disagreeing": {"chain": lambda x, z, rng: x + 1.16 * z},
    "agreeing": {"chain": lambda x, z, rng: x + 0.8 * z},
}
"""Changes of `folded` that make a fault, by its cause; the first is of the sensor that has it."""

FAR = 45
"""Seconds by which a weak fault's begin and end are known: see test_effects.py, twice the correlated one's."""


@cases(__file__, "sensor_faults.csv")
def test_one_fault_of_a_sensor_is_one_episode(cause, subject, unit, least, most, words):
    fold = folded(**SENSORS[cause])
    # What a wrong sensor does to the estimate, the others contradict: that is an episode of theirs.
    found = [each for each in episodes(fold) if each.subject.startswith(subject)]
    assert [each.cause for each in found] == [cause]
    (each,) = found
    assert each.unit == unit
    assert float(least) <= each.size <= float(most) and not each.low > each.size and not each.high < each.size
    assert abs(each.start - BEGIN - 1) <= FAR and each.end is not None and abs(each.end - END) <= FAR
    for part in words.split(" … "):
        assert part in each.text
    assert "\n" not in each.text and each.text[-1] != "."


def test_one_that_lasts_for_more_readings_than_its_size_is_made_of_ends_where_it_ended(monkeypatch):
    monkeypatch.setattr("estimators.diagnostics.episodes.sensors.MAX_MEASUREMENTS", 60)
    (each,) = (item for item in episodes(folded(**SENSORS["narrow"])) if item.subject == "gauge")
    assert each.end is not None and abs(each.end - END) <= FAR


@pytest.mark.parametrize("cause", ["refused", "stuck"])
def test_what_is_certain_has_its_readings_exactly(cause):
    (each,) = (item for item in episodes(folded(**SENSORS[cause])) if item.cause == cause)
    # Until the last reading that was refused, or equal.
    assert (each.start, each.end) == (BEGIN + 1.0, float(END))


def test_in_order_there_is_none():
    assert [episodes(folded(seed=seed)) for seed in range(4)] == [[]] * 4


def only(found, cause):
    assert [each.cause for each in found].count(cause) == 1
    return next(each for each in found if each.cause == cause)


def test_silence():
    """Since the last reading; and it ends with the next."""
    found = episodes(folded(skip=(0,)))
    each = only(found, "silent")
    assert len(found) == 1
    assert (each.subject, each.start, each.end, each.unit) == ("gauge", BEGIN, END + 1.0, "s")
    assert each.size == END + 1 - BEGIN
    said = f"gauge did not report for {END + 1 - BEGIN} s, since {BEGIN}.0 s: other sensors measure the same states; "
    assert each.text == said + "check its wiring and its bus"


def test_a_sensor_that_should_speak_and_never_does():
    events = folded().log.events
    kept = events.select(np.flatnonzero((events.kind != READING) | (events.channel == 1)))
    fold = advanced("kf", MODEL, as_log(kept), policy=POLICY, expected=np.array([1, 1]))
    (each,) = episodes(fold)
    assert (each.subject, each.cause, each.start, each.end) == ("gauge", "never heard", 1.0, None)
    said = "gauge has never reported: other sensors measure the same states; check its channel map and its bus"
    assert each.text == said


def test_a_twin_without_readings_is_stale():
    found = episodes(folded(skip=(0, 1)))
    assert {each.cause for each in found} >= {"silent", "stale"}
    each = only(found, "stale")
    assert (each.subject, each.start, each.unit) == ("twin", BEGIN, "s")
    assert each.end == END + 1.0
    said = f"no measurement was used since {BEGIN}.0 s: the estimate is a prediction of the model; check the source"
    assert each.text == said


def test_a_known_truth_takes_no_part_in_health():
    """It is 20 σ off: an asset of which no truth is known would show the same."""
    fold = folded(truth=2.0)
    assert not episodes(fold) and set(fold.track.health) <= {WAITING, TRACKING}


def test_an_input_outside_its_range():
    fold = folded(feed=-1.5, skip=(0, 1))
    found = {(each.subject, each.cause): each for each in episodes(fold)}
    each = found["feed", "outside"]
    assert (each.start, each.end, each.size, each.low, each.high) == (BEGIN + 1.0, END + 1.0, -1.5, -1.5, -1.5)
    assert each.unit == "m/s"
    assert each.text == (
        f"feed is -1.5 m/s, outside -1 to 1 where the model was fitted, since {BEGIN + 1}.0 s: bands are valid only "
        "inside; fit the model there"
    )
    # The level sinks 1.5 m a second from about 0: beyond -20 after some 13 s.
    level = found["level", "outside"]
    assert BEGIN + 10 <= level.start <= BEGIN + 17 and level.unit == "m" and level.size < -250.0
    each, track = found["level", "impossible"], fold.track
    beyond = fold.log.t[: fold.n][track.mean[:, 0] + 1.959963984540054 * track.std[:, 0] < -100.0] * 1e-9
    assert (each.start, each.size, each.grade) == (beyond[0], track.mean[:, 0].min(), "suspect")
    said = f", as it reached {each.size:.4g} m with a band beyond -100 to 100"
    assert each.text.startswith(f"level is wrong since {each.start:.1f} s{said}")


def test_a_gate_that_refuses_all_is_divergence():
    fault = {"gauge": lambda x, z, rng: x + 9.0, "chain": lambda x, z, rng: x + 9.0 + 0.1 * z, "gate": 0.9999}
    each = only(episodes(folded(**fault)), "diverged")
    assert each.subject == "twin" and BEGIN < each.start < BEGIN + 50 and each.end is not None
    assert each.text.startswith("the estimate has diverged since")


def test_an_impoverished_cloud():
    judged = judged_rows(folded())
    track = judged.track.copy()
    track.flags[1000:2000] |= IMPOVERISHED
    track.effective[1000:2000], track.ancestors[1000:2000] = np.linspace(1.0, 3.0, 1000), 1.0
    (found,) = found_in(judged._replace(track=track))
    each = found.episode
    t = judged.events.t * 1e-9
    assert (each.subject, each.cause, each.start, each.end) == ("twin", "impoverished", t[1000], t[2000])
    assert (each.low, each.size, each.high) == pytest.approx((1.05, 2.0, 2.95))
    assert "2 effective particles, all from one particle" in each.text


# Runs of alarms


def alarmed(*readings, cause="narrow"):
    """Alarms of the gauge at those of its readings, or a state corrected at those of all; else all is in order."""
    judged = judged_rows(folded())
    track = judged.track.copy()
    if cause == "corrected":
        track.flags[np.flatnonzero(judged.events.kind == READING)[list(readings)]] = memory_flag(0)
    else:
        track.alarms[judged.events.of_sensor(0)[list(readings)], 0] = NARROW
    return found_in(judged._replace(track=track))


@pytest.mark.parametrize(("cause", "readings"), [("narrow", N), ("corrected", 2 * N)])
def test_alarms_that_follow_each_other_are_one_episode_which_lasts_while_it_may_go_on(cause, readings):
    """With 100 quiet readings between them they do; with 101 they do not."""
    for first, count in ((101 + JOINED, 1), (102 + JOINED, 2)):
        assert len(alarmed(100, first, cause=cause)) == count
    ended, lasting = (alarmed(readings - k - JOINED, cause=cause) for k in (2, 1))
    assert ended[0].episode.end is not None and lasting[0].episode.end is None


def test_episodes_come_in_the_order_of_their_start():
    found = alarmed(900, 200, 500)
    starts = [item.episode.start for item in found]
    assert len(found) == 3 and starts == sorted(starts)
    assert [item.begin for item in found] == [200, 500, 900]
    assert {item.key for item in found} == {("sensor", "gauge")}


def test_episodes_of_several_bits_are_one():
    judged = judged_rows(folded())
    track = judged.track.copy()
    rows = judged.events.of_sensor(1)
    track.alarms[rows[100:120], 0], track.alarms[rows[110:130], 3] = NARROW, SHIFTED
    assert len(found_in(judged._replace(track=track))) == 1


def test_a_noisy_sensor_that_rests_for_a_while_is_not_stuck():
    """It is what it was for most of its alarms: 170 s too noisy, then 30 s of one value."""

    def change(x, z, rng):
        y = x + 0.6 * z
        y[170:] = y[170]
        return y

    fold = folded(gauge=change)
    assert not np.any(fold.track.alarms[fold.log.events.of_sensor(0), 0] & STUCK)
    assert [each.cause for each in episodes(fold) if each.subject == "gauge"] == ["narrow"]


def test_what_was_normal_is_no_cause_unless_its_test_spoke():
    """Spikes of 6 σ, one reading in 15, as always; from BEGIN on 1 σ more."""
    judged = judged_rows(folded())
    track, rng = judged.track.copy(), np.random.default_rng(1)
    rows = judged.events.of_sensor(0)
    e = rng.standard_normal(N)
    e[::15] = 6.0 * rng.choice([-1.0, 1.0], e[::15].shape)
    e[BEGIN:END] += 1.0
    track.innovation[rows, 0] = e * track.innovation_std[rows, 0]
    track.alarms[rows[BEGIN + 20 : END], 0] = SHIFTED
    baseline = no_baseline(MODEL)
    baseline[0, 3:][BITS & (SPIKY | NARROW) != 0] = 1e4
    for normal, cause in ((None, "spiky"), (baseline, "shifted")):
        own = judged._replace(track=track, tuning=replace(judged.tuning, baseline=normal))
        assert [item.episode.cause for item in found_in(own)] == [cause]


# For scripts


def test_json_has_every_field_and_no_nan():
    text = json.dumps([episode_json(each) for each in episodes(folded(skip=(0, 1)))], allow_nan=False)
    for each in json.loads(text):
        assert tuple(each) == Episode._fields
        assert each["cause"] in CAUSES and each["low"] is None and isinstance(each["size"], float)


def test_numbers_are_those_of_python():
    for cause in ("shifted", "stuck"):
        for each in episodes(folded(**SENSORS[cause])):
            assert {type(value) for value in each} <= {float, str, type(None)}


def cut(until, **faults):
    """A judged that is known only up to a second of the log."""
    judged = judged_rows(folded(**faults))
    n = int(np.searchsorted(judged.events.t, until * SECOND, side="right"))
    return judged._replace(events=judged.events.select(slice(0, n)), track=judged.track.select(slice(0, n)))


def of_gauge(judged):
    return [item.episode for item in found_in(judged) if item.key == ("sensor", "gauge")]


def test_what_is_back_to_normal_is_said_while_the_slowest_test_still_falls():
    """After a shift of 5 σ that of 0.2 σ falls for hundreds of readings; its end shows in a few."""
    fault = {"gauge": lambda x, z, rng: x + 0.2 * z + 1.5}
    for until in (*range(BEGIN + 20, END, 20), END):
        (each,) = of_gauge(cut(until, **fault))
        assert each.end is None and "back to normal" not in each.text, until
    judged = cut(END + 15, **fault)
    gauge = judged.events.of_sensor(0)
    assert judged.track.alarms[gauge[-1], 0] != 0
    (each,) = of_gauge(judged)
    since = float(re.search(r"; back to normal since ([\d.]+) s: the alarm clears", each.text)[1])
    # The filter has followed by 4 of the 5 σ, so that the last readings of the fault look much like those after it.
    assert each.end is None and abs(since - END) <= 15


def test_a_reset_is_advised_only_when_no_sensor_is_off():
    """The estimate is lost while two sensors are refused, then while one is, then with all in order."""
    fault = {"gauge": lambda x, z, rng: x + 9.0, "chain": lambda x, z, rng: x + 9.0 + 0.1 * z, "gate": 0.9999}
    judged = judged_rows(folded(**fault))

    def text(verdicts):
        track = judged.track.copy()
        n = int(np.searchsorted(judged.events.t, (BEGIN + 60) * SECOND))
        track.alarms[:], track.health[:n] = 0, TRACKING
        track.health[n - 40 : n] = DIVERGED
        kind, channel = judged.events.kind[:n], judged.events.channel[:n]
        for s, verdict in enumerate(verdicts):
            track.verdict[:n][(kind == READING) & (channel == s)] = verdict
        part = judged._replace(events=judged.events.select(slice(0, n)), track=track.select(slice(0, n)))
        return only([item.episode for item in found_in(part)], "diverged").text

    remedy = "and reset the twin when the others agree"
    assert text((GATED, GATED)).endswith(
        f"and gauge, chain still contradict it: hold them out first, one by one, {remedy}"
    )
    assert text((USED, GATED)).endswith(f"and chain still contradicts it: hold it out first, {remedy}")
    assert text((USED, USED)).endswith("reset the twin to its prior, then check the sensor that was in alarm first")


@pytest.mark.parametrize(("cause", "factor"), [*((cause, np.nan) for cause in SENSORS), ("stuck", 1e9)])
def test_a_row_without_a_possible_value_tells_nothing(cause, factor):
    """Episodes are as if it were not there: each tenth in the fault, and without a value all that end it."""
    fold = folded(**SENSORS[cause])
    events, t = fold.log.events, fold.log.events.t // SECOND
    sensor = MODEL.sensor_names.index(next(iter(SENSORS[cause])))
    rows = (events.kind == READING) & (events.channel == sensor) & (t > BEGIN)
    tenth, ending = rows & (t % 10 == 5), rows & (t > END - 40)
    faulty = events.copy()
    faulty.value[tenth] *= factor
    faulty.value[ending] = np.nan
    found, expected = (
        episodes(advanced("kf", LIMITED, as_log(each), replace(fold.tuning, model=LIMITED), policy=POLICY))
        for each in (faulty, events.select(~tenth & ~ending))
    )
    assert [repr(each) for each in found] == [repr(each) for each in expected]
    assert {(each.cause, each.end) for each in found} >= {(cause, None), ("silent", None)}


def test_a_row_without_a_value_is_stuck_while_others_of_its_sensor_have_values():
    def chain(x, z, rng):
        y = x + z
        y[:, 3], y[150:, 3] = x[0], np.nan
        return y

    before, after = (found_in(cut(end, chain=chain)) for end in (BEGIN + 150, END))
    assert [(each.episode.cause, each.episode.text) for each in after] == [("stuck", before[0].episode.text)]
    assert before[0].episode.text.startswith("chain.c3 is stuck")


def test_a_stuck_sensor_that_moves_again_is_over_whatever_other_alarms_follow():
    """Its noise is tenfold after a hundred equal readings, which the other sensor contradicts."""

    def gauge(x, z, rng):
        return np.where(np.arange(END - BEGIN)[:, None] < 100, x[0] + 1.5, x + 2.0 * z)

    (each,) = of_gauge(cut(BEGIN + 90, gauge=gauge))
    assert (each.cause, each.end, each.grade) == ("stuck", None, "degraded")
    found = of_gauge(cut(BEGIN + 250, gauge=gauge))
    assert [(item.cause, item.end and round(item.end, 6), item.grade) for item in found] == [
        ("stuck", BEGIN + 100.0, "degraded"),
        ("narrow", None, "suspect"),
    ]


@pytest.mark.parametrize("begun_anew", [False, True])
def test_the_onset_of_an_episode_is_not_before_the_reset_nor_in_the_episode_before(begun_anew):
    """Two shifts of the gauge, the second lesser: what was off before would make an earlier start of it likelier."""

    def of(shift, seconds, later):
        events = folded(gauge=lambda x, z, rng: x + shift + 0.2 * z).log.events
        events = events.select(np.isin(events.t, seconds * SECOND))
        return events._replace(t=events.t + later * SECOND, arrival=events.arrival + later * SECOND)

    cut, back = END + 100, BEGIN - 100
    first, second = of(0.8, np.arange(1, cut), 0), of(0.4, np.arange(back, N + 1), cut - back)
    parts = [first, Events.one(cut * SECOND, cut * SECOND, RESET, 0, (), MODEL.width), second]
    fold = advanced("kf", MODEL, as_log(Events.concat(parts if begun_anew else parts[::2], MODEL.width)))
    found = [each for each in episodes(fold) if each.subject == "gauge"]
    assert found[0].start == pytest.approx(BEGIN, abs=10) and found[0].end == pytest.approx(END, abs=30)
    assert found[1].start == pytest.approx(cut + 100, abs=10)


@pytest.mark.parametrize(("states", "said"), [("x", "x is"), ("xy", "x and y are"), ("xyz", "x, y and z are")])
def test_states_that_one_sensor_alone_observes_are_listed(states, said):
    model = level_model(
        {"total": 1.0}, 1.0, h=total, states=tuple(State(name, "1") for name in states), f=unchanged,
        noises=(Noise(states[0], "1/s", 1.0),),
    )  # fmt: skip
    assert SensorFacts(cause="silent", start=0.0, model=model, s=0).observed_by == f"{said} measured by no other sensor"


def total(x, u, p, out):
    out[0] = np.sum(x)
