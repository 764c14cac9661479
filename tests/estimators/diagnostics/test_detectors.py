"""The bank of tests against its words: an oracle in plain Python, from densities, on streams where all goes wrong."""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.diagnostics.detector_state import no_baseline
from estimators.diagnostics.detectors import (
    ADVISORY_ALARM,
    ALARM_NAMES,
    FAR_OUTSIDE,
    IMPOSSIBLE,
    IMPOSSIBLE_AT,
    MEMORY_AT,
    OUTSIDE,
    memory_flag,
)
from estimators.diagnostics.health import HealthPolicy
from estimators.fold import Fold, fold
from estimators.log import INPUT, READING, RESET, TICK, TRUTH, Events, Log
from estimators.model.parts import Limits
from estimators.model.state_space import Input, Noise, Row, Sensor, State, StateSpaceModel
from estimators.track import (
    ADVISORY,
    DEGRADED,
    DIVERGED,
    DUPLICATE,
    FAILED,
    GATED,
    HELD_OUT,
    MISSING,
    RANGE,
    RATE,
    SCREENED,
    STALE,
    SUSPECT,
    TRACKING,
    USED,
    WAITING,
)
from estimators.tuning import Tuning
from tests.models import first_state
from tests.support import SECOND, as_log, assert_same, folded


def f(x, u, p, dt, out):
    out[0] = x[0] + dt * (u[0] - 0.2 * x[0])
    out[1] = x[1] + dt * (0.5 * x[0] - 0.3 * x[1])


def two(x, u, p, out):
    out[0] = x[1]
    out[1] = x[0] + x[1]


def other(x, u, p, out):
    out[0] = x[1] - x[0]


MODEL = StateSpaceModel(
    name="tanks",
    title="two tanks",
    states=(
        State("a", "m", mean=0.0, std=1.0, fitted=(-3.0, 3.0), limits=(-3.5, 3.5)),
        State("b", "m", mean=0.0, std=1.0),
    ),
    inputs=(Input("feed", "m/s", fitted=(-1.0, 1.0)),),
    noises=(Noise("a", "m²/s", 0.04), Noise("b", "m²/s", 0.04)),
    sensors=(
        Sensor("one", (Row("one", "m", 0.25),), h=first_state, limits=Limits(range=((-9.0, 9.0),))),
        Sensor("two", (Row("low", "m", 0.09), Row("high", "m", 0.36)), h=two, limits=Limits(range=((-9.0, 9.0),) * 2)),
        Sensor("other", (Row("other", "m", 0.25),), h=other),
    ),
    f=f,
    linear=True,
)
ROWS = ((0,), (1, 2), (3,))
R = (0.25, 0.09, 0.36, 0.25)
POLICY = HealthPolicy(
    window=20, degraded_after=3.0, stale_after=12.0, diverged_nis=30.0, diverged_gated=0.9, false_alarm_every=600.0
)
"""Of the window little is asked, so that what the tests say is seen."""
CORRECTED = sum(memory_flag(k, at) for k in (0, 1) for at in (MEMORY_AT, IMPOSSIBLE_AT))  # See test_memory.py


# The oracle


def log_normal(x, mean, variance):
    return -0.5 * ((x - mean) ** 2 / variance + math.log(2.0 * math.pi * variance))


def white(e):
    return log_normal(e, 0.0, 1.0)


GAINS, FADING = (0.2, 0.5), 0.95
"""Of filters that follow noise: e is (1 - fading L) / (1 - (1 - gain) L) of white noise, at unit variance."""


class Follower:
    """log Λ of the innovations of a filter that follows noise: an ARMA(1, 1) by its noise, found from all e before."""

    def __init__(self, gain):
        self.gain, self.noise, self.e = gain, 0.0, 0.0
        # Its impulse response, summed by force, gives the variance of e.
        h = [1.0]
        for _ in range(500):
            h.append((1.0 - gain) * h[-1] - (FADING if len(h) == 1 else 0.0))
        self.variance = 1.0 / sum(x * x for x in h)

    def ratio(self, e):
        expected = (1.0 - self.gain) * self.e - FADING * self.noise
        self.noise, self.e = e - expected, e
        return log_normal(e, expected, self.variance) - white(e)


def mixed(e, share):
    return math.log(share * math.exp(log_normal(e, 0.0, 25.0)) + (1.0 - share) * math.exp(white(e)))


def bank_of_a_row():
    """(cause, log Λ of e and the e before) of every test of innovations, from the densities."""
    for v in (1.5, 2.5, 6.0, 0.6, 0.3, 0.05):
        yield ("narrow" if v > 1 else "wide"), lambda e, _, v=v: log_normal(e, 0.0, v) - white(e)
    for m in (0.2, 0.5, 1.5, -0.2, -0.5, -1.5):
        yield ("shifted up" if m > 0 else "shifted down"), lambda e, _, m=m: log_normal(e, m, 1.0) - white(e)
    for phi in (0.25, 0.6, -0.25, -0.6):
        cause = "correlated" if phi > 0 else "alternating"
        yield cause, lambda e, last, phi=phi: log_normal(e, phi * last, 1.0 - phi**2) - white(e)
    for _ in GAINS:
        yield "alternating", None  # of all e before: see Follower
    for share in (0.03, 0.003):
        yield "spiky", lambda e, _, share=share: mixed(e, share) - white(e)


OF_INNOVATIONS = tuple(bank_of_a_row())
FIRST_GAIN = next(k for k, (_, ratio) in enumerate(OF_INNOVATIONS) if ratio is None)
PER_ROW = len(OF_INNOVATIONS) + 2
N_TESTS = 4 * PER_ROW + 6


class Cusum:
    """W ← min(max(W, 0) + log Λ, threshold + 1); one reading is worth half of h at most."""

    def __init__(self, cause):
        self.cause, self.W = cause, 0.0

    def put(self, ratio, h, peak, before):
        threshold = h + peak
        self.W = min(max(self.W, 0.0) + min(ratio, 0.5 * h), threshold + 1.0)
        self.on = self.W >= threshold or self.W >= 0.85 * threshold and self.cause in before
        return {self.cause} if self.on else set()


class RowOracle:
    def __init__(self, base):
        self.base = base
        self.value, self.quantum, self.run, self.equal, self.counted = None, None, 0, 0, 0
        self.std, self.std_before, self.resetting = 0.0, 0.0, 0
        self.forget()

    def forget(self):
        self.std_before = self.std_before if self.resetting else self.std
        self.resetting = POLICY.window if self.std_before else 0
        self.std, self.left, self.steps, self.grown, self.recent, self.grade = 0.0, None, [], [], [0.0, 0.0, 0], None
        self.tests = [Cusum(cause) for cause, _ in OF_INNOVATIONS]
        self.followers = {FIRST_GAIN + k: Follower(gain) for k, gain in enumerate(GAINS)}
        self.refusals, self.repetition = Cusum("refused"), Cusum("stuck")
        self.raw = self.before = None
        self.calm, self.outside, self.share = 0, 0, 0.0
        self.said = set()

    def innovation(self, e, h, sensor):
        # The share outside the bands in 600 s, and at least 100 measurements.
        period = (sensor.times[-1] - sensor.times[0]) / len(sensor.times)
        self.outside = min(self.outside + 1, max(100, 600.0 / max(period, 1e-6)))
        self.share += ((abs(e) > 1.959963984540054) - self.share) / self.outside
        bias, scale, phi = self.base[:3]
        raw = min(max((e - bias) / scale, -6.0), 6.0)
        white = raw
        if phi and self.raw is not None:
            white = min(max((raw - phi * self.raw) / math.sqrt(1.0 - phi**2), -6.0), 6.0)
        self.calm = 0 if abs(white) > 3.5 else self.calm + 1
        if abs(white) <= 3.5:
            # Averages over 200, the first 20 of which are taken for white noise.
            mean, square, n = self.recent
            n = min(n + 1, 180)
            self.recent = [mean + (raw - mean) / (n + 20), square + (raw * raw - 1.0 - square) / (n + 20), n]
        said = set()
        for k, (test, (cause, ratio)) in enumerate(zip(self.tests, OF_INNOVATIONS, strict=True)):
            if k in self.followers:
                said |= test.put(self.followers[k].ratio(white), h, self.base[3 + k], self.said)
                continue
            if self.before is None and cause in ("correlated", "alternating"):
                continue
            last = 0.0 if self.before is None else self.before
            if cause == "spiky" and self.calm >= 500:
                test.W = 0.0
            # The last one, rare spikes, stands alone.
            if k == len(self.tests) - 1 and said - {"spiky"}:
                test.W = 0.0
                continue
            said |= test.put(ratio(white, last), h, self.base[3 + k], self.said)
        self.raw, self.before = raw, white
        return said

    def resets(self, std):
        """Whether the prior of a reset dominates a prediction."""
        if self.resetting and (not self.std or not std <= 1.2 * self.std_before):
            self.resetting -= 1
            return True
        self.resetting = 0
        return False

    def moves(self, nu, std, r, used, same):
        """Whether something contradicts that a value is the one before."""
        left, self.left = self.left, None
        if not same:
            self.steps, self.grown = [], []
        if not np.isfinite(nu):
            return False
        S, gain = std**2, (1.0 - r / std**2 if used else 0.0)
        self.std, self.left = std, ((1.0 - gain) * nu, (1.0 - gain) * (S - r))
        if not same or left is None:
            return False
        # The predicted value went from y less what the update had left of its innovation to y less this one.
        self.steps.append(left[0] - nu)
        self.grown.append(max(0.0, S - r - left[1]))
        moved = abs(sum(self.steps))
        evident = moved > 3.0 * max(self.quantum or 0.0, math.sqrt(r))
        coherent = moved > 4.0 * math.sqrt(sum(step**2 for step in self.steps))
        if self.run >= 8:
            coherent |= moved > 4.0 * math.sqrt(sum(self.grown))
        return evident and coherent or used and self.grown[-1] < 0.04 * r

    def graded(self, said, gated, r):
        """None without an alarm, "advisory" where the bands are valid."""
        if not said:
            return None
        rest = said - {"wide", "agreeing"}
        mean, square, _ = self.recent
        if gated and "spiky" in rest:
            rest -= {"spiky", "narrow"} if square < 0.3 else {"spiky"}
        # The share beyond which a test of 10 % rejects it, with a risk of 5 %.
        if self.share <= 0.1 + 1.645 * 0.3 / math.sqrt(max(self.outside, 1)):
            rest -= {"narrow", "spiky", "alternating"}
        if abs(mean * self.base[1] + self.base[0]) < abs(self.base[0]):
            rest -= {"shifted up", "shifted down"}
        share = 1.0 - r / self.std**2 if self.std else 0.0
        if mean**2 <= share:
            lagging = {"correlated", "alternating"}
            if share >= 0.5 and square < -0.05:
                rest -= lagging | {"shifted up", "shifted down"}
            elif square < -0.2:
                rest -= lagging
        return "suspect" if rest else "advisory"

    def repeat(self, y, r, h, nu, std, used):
        last, self.value = self.value, y
        moves = self.moves(nu, std, r, used, y == last)
        if last is None:
            return set()
        if y == last:
            self.run += 1
            chance = 0.5
            if self.quantum is not None:
                share = self.equal / self.counted
                chance = min(max(math.erf(0.5 * self.quantum / math.sqrt(r)), 0.01, share), 0.999)
            ratio = math.log(0.999 / chance) if moves else 0.0
        else:
            step = abs(y - last)
            self.quantum = step if self.quantum is None else min(step, self.quantum)
            self.equal, self.counted, self.run = self.equal + self.run, self.counted + self.run + 1, 0
            # Another value ends it for certain: more than W can hold.
            ratio = math.log(0.001 / 0.5) - h
        return self.repetition.put(ratio, h, self.base[-1], self.said)


class SensorOracle:
    def __init__(self):
        self.times, self.silent, self.due, self.h, self.longest = [], False, math.inf, 0.0, 0.0
        self.forget()

    def forget(self):
        self.together = [Cusum(cause) for cause in ["disagreeing"] * 3 + ["agreeing"] * 3]
        self.said = set()

    def speaks(self, now):
        if self.times:
            self.longest = max(self.longest, now - self.times[-1])
        self.times.append(now)
        n = len(self.times)
        period = (now - self.times[0]) / (n - 1) if n > 1 else 0.0
        if n <= 16 or math.log2(n).is_integer():
            readings = POLICY.false_alarm_every / max(period, 1e-3)
            self.h = math.log(max(readings, 8.0) * N_TESTS)
        patience = POLICY.silent_periods * period
        if n < 100:
            patience = max(patience, min(patience * 100 / n, POLICY.stale_after))
        self.due = now + max(patience, 2.0 * self.longest) if n > 2 else math.inf
        self.silent = False

    def scale(self, nis, dof):
        said = set()
        for test, v in zip(self.together, (1.5, 2.5, 6.0, 0.6, 0.3, 0.05), strict=True):
            ratio = 0.5 * (1.0 - 1.0 / v) * min(nis, 36.0 * dof) - 0.5 * dof * math.log(v)
            said |= test.put(ratio, self.h, 0.0, self.said)
        self.said = said
        return said


def by_definition(events, track, gate, baseline, expected):
    """alarms, flags and health of each row, from what the filter left in the track."""
    sensors, rows = [SensorOracle() for _ in ROWS], [RowOracle(base) for base in baseline]
    chance = 0.15 if gate is None else min(max(1e-6, 1.0 - gate), 0.15)
    refusal, acceptance = math.log(0.3 / chance), math.log(0.7 / (1.0 - chance))
    feed, heard, unsettled = 0.0, False, 0
    begun = events.t[0] * 1e-9
    for s, needed in enumerate(expected):
        if needed:
            sensors[s].due = begun + POLICY.stale_after
    for i in range(len(events)):
        now, kind, s = events.t[i] * 1e-9, events.kind[i], int(events.channel[i])
        alarms = np.zeros(track.alarms.shape[1], int)
        if kind == READING:
            verdict = track.verdict[i]
            # Without a value in any row it says no more than silence does.
            says = bool(np.isfinite(events.value[i, : len(ROWS[s])]).any())
            heard |= says and verdict != SCREENED
            unsettled = max(0, unsettled - (says and verdict != SCREENED))
            if says and not np.any(track.screened[i] & DUPLICATE):
                sensor = sensors[s]
                sensor.speaks(now)
                judged = verdict in (USED, GATED)
                plain = tuple(baseline[ROWS[s][0], :3]) == (0.0, 1.0, 0.0)
                fresh = any(rows[index].resetting for index in ROWS[s])
                if judged and len(ROWS[s]) > 1 and plain and not fresh:
                    sensor.scale(track.nis[i], track.dof[i])
                elif judged:
                    sensor.said = set()
                together = sensor.said if judged else set()
                for k, index in enumerate(ROWS[s]):
                    row, y = rows[index], events.value[i, k]
                    if not np.isfinite(y):
                        continue
                    nu, std = track.innovation[i, k], track.innovation_std[i, k]
                    begins = row.resets(std)
                    said, screened = row.said, track.screened[i, k] != 0
                    if not track.screened[i, k] & (RANGE | RATE):  # such a value is none
                        said = (said - {"stuck"}) | row.repeat(y, R[index], sensor.h, nu, std, verdict == USED)
                    if (judged or verdict == FAILED or screened) and not begins:
                        ratio = acceptance if verdict == USED and not screened else refusal
                        said = (said - {"refused"}) | row.refusals.put(ratio, sensor.h, row.base[-2], row.said)
                    if judged and not screened and not begins:
                        e = nu / std
                        said = (said & {"refused", "stuck"}) | row.innovation(e, sensor.h, sensor)
                    if k == 0:
                        said = said - {"disagreeing", "agreeing"} | (together if judged else sensor.said)
                    row.said, row.grade = said, row.graded(said, gate is not None, R[index])
            for k, index in enumerate(ROWS[s]):
                alarms[k] = sum(1 << ALARM_NAMES.index(cause) for cause in rows[index].said)
                alarms[k] |= ADVISORY_ALARM * (rows[index].grade == "advisory")
        elif kind == INPUT and np.isfinite(events.value[i, 0]):
            feed = events.value[i, 0]
        elif kind == RESET:
            for each in (*sensors, *rows):
                each.forget()
            unsettled = POLICY.window
        for sensor in sensors:
            sensor.silent |= now > sensor.due
        silent = sum(1 << s for s, sensor in enumerate(sensors) if sensor.silent)
        flags = silent | int(track.flags[i]) & CORRECTED
        # Of a range of ±1 5 % more counts, and half of its width is far.
        beyond = max(abs(track.mean[i, 0]) / 3.0, abs(feed))
        flags |= (OUTSIDE if beyond > 1.1 else 0) | (FAR_OUTSIDE if beyond > 2.0 else 0)
        beyond = abs(track.mean[i, 0]) - 1.959963984540054 * track.std[i, 0] > 3.5
        if beyond or flags & memory_flag(0, IMPOSSIBLE_AT):
            flags |= IMPOSSIBLE
        said = set().union(*(row.said for row in rows))
        if not heard:
            health = STALE if now - begun > POLICY.stale_after else WAITING
        elif track.age[i] > POLICY.stale_after:
            health = STALE
        elif track.consistency[i] == DIVERGED and not unsettled:
            health = DIVERGED
        elif track.age[i] > POLICY.degraded_after or silent or said & {"refused", "stuck"}:
            health = DEGRADED
        else:
            grades = {row.grade for row in rows}
            health = SUSPECT if "suspect" in grades or flags else ADVISORY if "advisory" in grades else TRACKING
        yield alarms, flags, health


# Streams


def stream(rng, n):
    """Readings of three sensors, drawn from the model, through spells in which one thing after the other is wrong."""
    spells = ("fine", "loud", "quiet", "high", "stuck", "spikes", "wild", "drift", "silent", "coarse", "feed", "lie")
    t, x, batch, spell, left, offset, target = 0, np.zeros(2), [], "fine", 60, 0.0, 0
    held = {}

    def put(kind, channel, value):
        batch.append(Events.one(t, t, kind, channel, value, MODEL.width))

    put(TICK, 0, ())
    while len(batch) < n:
        dt = rng.choice([0.1, 0.2, 0.3])
        t += round(dt * SECOND)
        x = x + dt * np.array([-0.2 * x[0], 0.5 * x[0] - 0.3 * x[1]]) + rng.normal(0.0, np.sqrt(0.04 * dt), 2)
        left -= 1
        if left < 0:
            spell, left, target = str(rng.choice(spells)), int(rng.integers(20, 120)), int(rng.integers(3))
            offset, held = 0.0, {}
            if spell == "feed":
                put(INPUT, 0, rng.choice([-2.0, 2.0]))
            elif rng.random() < 0.3:
                put(INPUT, 0, 0.0)
            if rng.random() < 0.15:
                put(RESET, 0, ())
                x = rng.normal(0.0, 1.0, 2)
        if spell == "silent" and rng.random() < 0.1:
            t += round(rng.choice([0.5, 2.0, 15.0]) * SECOND)
            put(TICK, 0, ())
        for s in range(3):
            if rng.random() < 0.2 or spell == "silent" and s == target:
                continue
            exact = (x[:1], np.array([x[1], x[0] + x[1]]), x[1:] - x[:1])[s]
            noise = rng.normal(0.0, np.sqrt([R[k] for k in ROWS[s]]))
            if s == target:
                offset += 0.02 if spell == "drift" else 0.0
                noise *= {"loud": 2.5, "quiet": 0.1}.get(spell, 1.0)
                offset = {"high": 1.0}.get(spell, offset)
                if spell == "spikes" and rng.random() < 0.1:
                    noise *= 8.0
            y = exact + noise + (offset if s == target else 0.0)
            if spell == "coarse" and s == target:
                y = np.round(y * 2.0) / 2.0
            if spell == "wild" and s == target:
                y[rng.random(y.size) < 0.5] = 20.0
            if spell == "stuck" and s == target:
                y = held.setdefault(s, y)
            y = np.where(rng.random(y.size) < 0.05, np.nan, y)
            put(READING, s, y)
            if rng.random() < 0.01:
                put(READING, s, y)
        if rng.random() < 0.2:
            lie = 3.0 if spell == "lie" else 0.0
            put(TRUTH, 0, np.where(rng.random(2) < 0.2, np.nan, x + lie))
    return Events.concat(batch, MODEL.width)


def setting(rng, seed):
    """A tuning and sensors that must speak: gates, a sensor held out, what was normal before."""
    tuning = Tuning.of(MODEL).set("gate", [None, 0.999, 0.9999][seed % 3]).set("gate.reopen", None)
    if seed % 4 == 1:
        tuning = tuning.set("use.other", False)
    baseline = no_baseline(MODEL)
    if seed % 2:
        baseline[seed % 4, :3] = 0.3, 1.4, 0.35
        baseline[seed % 4, 3:] = rng.uniform(0.0, 4.0, baseline.shape[1] - 3)
    return replace(tuning, baseline=baseline), np.array([1, 0, 1])


@lru_cache
def of_seed(seed):
    """A stream, its tuning and the sensors that must speak, and its fold."""
    rng = np.random.default_rng(seed)
    events = as_log(stream(rng, 4000)).events
    tuning, expected = setting(rng, seed)
    track = folded("kf", MODEL, as_log(events), tuning, policy=POLICY, expected=expected).track
    return events, tuning, expected, track


@pytest.mark.parametrize("seed", range(8))
def test_the_bank_is_its_definition(seed):
    events, tuning, expected, found = of_seed(seed)
    said = by_definition(events, found, tuning.gate, tuning.baseline, expected)
    alarms, flags, health = (np.array(column) for column in zip(*said, strict=True))
    np.testing.assert_array_equal(found.flags, flags)
    different = np.flatnonzero((found.alarms != alarms).any(axis=1))
    assert not different.size, (different[:5], found.alarms[different[0]], alarms[different[0]])
    np.testing.assert_array_equal(found.health, health)


def test_all_that_can_be_said_is_said_in_those_streams():
    """Else the test above would say nothing of it."""
    bits, flags, healths, verdicts = 0, 0, set(), set()
    for seed in range(8):
        *_, track = of_seed(seed)
        bits |= int(np.bitwise_or.reduce(track.alarms, axis=None))
        flags |= int(np.bitwise_or.reduce(track.flags))
        healths |= set(track.health)
        verdicts |= set(track.verdict)
    assert bits == (1 << len(ALARM_NAMES)) - 1 | ADVISORY_ALARM
    assert flags & ~CORRECTED == OUTSIDE | FAR_OUTSIDE | IMPOSSIBLE | 0b111
    assert healths == {WAITING, TRACKING, ADVISORY, SUSPECT, DEGRADED, DIVERGED, STALE}
    assert verdicts >= {USED, GATED, HELD_OUT, MISSING, SCREENED}


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.lists(st.integers(1, 90), min_size=1, max_size=20), st.integers(0, 60))
def test_pieces_and_late_arrivals_change_nothing(seed, pieces, late):
    """The bank goes back with the fold: what came late is judged as if it had come in time."""
    rng = np.random.default_rng(seed)
    events = stream(rng, 600)
    tuning, expected = setting(rng, seed)
    whole = folded("kf", MODEL, as_log(events), tuning, policy=POLICY, expected=expected)
    # Readings of one sensor and time keep their order, as the log does: only whole times move.
    order = np.argsort(events.t + rng.integers(0, late + 1, events.t.max() // SECOND + 1)[events.t // SECOND] * SECOND,
                       kind="stable")  # fmt: skip
    log = Log(MODEL.width)
    growing = Fold("kf", MODEL, tuning, log, policy=POLICY, expected=expected)
    at, turn = 0, 0
    while at < len(events):
        end = at + pieces[turn % len(pieces)]
        start, _ = log.extend(events.select(order[at:end]))
        if start < growing.n:
            growing.rewind(start)
        growing.advance(int(rng.integers(1, 100)))
        at, turn = end, turn + 1
    growing.advance()
    assert_same(growing.track, whole.track)


def silent_rows(t):
    """At which of some times sensor `one`, which speaks at t (s), is silent for the twin, which is asked at 100 Hz."""
    ticks = np.arange(0.0, 15.0, 0.01)
    batch = [Events.one(round(s * SECOND), 0, READING, 0, (0.0,), MODEL.width) for s in t]
    batch += [Events.one(round(s * SECOND), 0, TICK, 0, (), MODEL.width) for s in ticks]
    log = as_log(Events.concat(batch, MODEL.width))
    track = fold("kf", MODEL, Tuning.of(MODEL), log, policy=POLICY)
    return log.t[: log.n][track.flags & 1 != 0] / SECOND


@pytest.mark.parametrize("hasty", [0.004, 0.01, 0.02])
def test_a_sensor_that_begins_in_haste_is_not_silent_when_it_finds_its_pace(hasty):
    """Three readings that come together, then ten a second."""
    assert silent_rows([0.0, hasty, 2 * hasty, *np.arange(1, 160) * 0.1]).size == 0


@pytest.mark.parametrize(("n", "after"), [(3, 12.0), (5, 12.0), (50, 1.2), (100, 0.6)])
def test_a_sensor_that_ends_early_is_silent_all_the_same(n, after):
    silent = silent_rows(np.arange(n) * 0.1)
    assert -1e-9 < silent[0] - (n - 1) * 0.1 - after <= 0.01 + 1e-9 and np.all(np.diff(silent) < 0.011)


# The state machine


def walk(wrong, *, gate=None, silent=(0.0, 0.0)):
    """States of the twin, without repeats, over five minutes of sensor `one`, four readings a second, off by wrong(t).

    Between the times of `silent` there are only ticks.
    """
    rng = np.random.default_rng(5)
    x, batch = 0.0, [Events.one(0, 0, TICK, 0, (), MODEL.width)]
    for k in range(1, 1200):
        x += -0.05 * x + rng.normal(0.0, 0.1)
        t, y = k * SECOND // 4, x + 0.5 * rng.normal() + wrong(k / 4)
        kind = TICK if silent[0] < k / 4 < silent[1] else READING
        batch.append(Events.one(t, t, kind, 0, y if kind == READING else (), MODEL.width))
    tuning = Tuning.of(MODEL).set("gate", gate).set("gate.reopen", None)
    health = fold("kf", MODEL, tuning, as_log(Events.concat(batch, MODEL.width)), policy=POLICY).health
    return [int(code) for code in health[np.flatnonzero(np.diff(health, prepend=-1))]]


@pytest.mark.parametrize(
    ("case", "states"),
    [
        ({"wrong": lambda t: 0.0}, [WAITING, TRACKING]),
        (
            {"wrong": lambda t: 2.0 * (-1) ** round(4 * t) * (40 < t < 60)},
            [WAITING, TRACKING, ADVISORY, SUSPECT, TRACKING],
        ),
        (
            {"wrong": lambda t: 4.0 * (40 < t < 43), "gate": 0.9999},
            [WAITING, TRACKING, DEGRADED, SUSPECT, ADVISORY, TRACKING],
        ),
        ({"wrong": lambda t: 0.0, "silent": (40, 50)}, [WAITING, TRACKING, DEGRADED, TRACKING]),
        ({"wrong": lambda t: 0.0, "silent": (40, 70)}, [WAITING, TRACKING, DEGRADED, STALE, TRACKING]),
        ({"wrong": lambda t: 0.0, "silent": (0, 60)}, [WAITING, STALE, TRACKING]),
    ],
    ids=["in order", "contrary", "refused", "silent", "stale", "late"],
)
def test_health_takes_each_step_once(case, states):
    """No flicker: one state follows the other, and when the cause has gone it is the first again."""
    assert walk(**case) == states
