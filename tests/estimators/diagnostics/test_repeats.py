"""Rows that repeat or interpolate a value are found, and measurements are not taken for such."""

import numpy as np
import pytest

from estimators.diagnostics.repeats import DEAD_BAND, HELD, LINEAR, SINGLE, STEPS, UNDECIDED, find_repeats
from estimators.log import READING
from sources.mapping import PRESENT, ChannelMapping
from sources.messages import Messages
from sources.source import Channel

SEEDS = range(10)


def walk(rng, n, q, step: float):
    """Measurements with a noise of 1 of a random walk, rounded to multiples of `step`."""
    y = 20.0 + np.cumsum(rng.normal(0.0, np.sqrt(q), n)) + rng.normal(0.0, 1.0, n)
    return np.round(y / step) * step if step else y


def found(y, dt=1.0):
    return find_repeats((np.arange(y.size) * dt * 1e9).astype(np.int64), y)


@pytest.mark.parametrize("q", [0.002, 0.2])
@pytest.mark.parametrize("step", [0.0, 0.1, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("period", [2.0, 2.5, 5.0, 10.0, 10.3, 60.0])
def test_held_values_have_the_period_at_which_they_change(period, step, q: float):
    named = 0
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        y = walk(rng, 201, q * period, step)[np.floor((np.arange(200 * period) + rng.uniform()) / period).astype(int)]
        one = found(y, 0.1)
        assert one.kind in (HELD, UNDECIDED)
        if one.kind == HELD:
            assert one.period == pytest.approx(0.1 * period, rel=0.005)
            assert one.share == np.mean(np.diff(y) == 0.0)
            named += 1
    # Of coarse values that change after two or three rows, a few runs are short of p < 1e-6.
    assert named == len(SEEDS) or (period == 2.5 and step >= 1.0)


def smooth(rng, step: float):
    """Band-limited noise without any of its rows."""
    power = np.fft.rfft(rng.normal(0.0, 1.0, 3000))
    y = np.fft.irfft(np.where(np.arange(power.size) < 250, power, 0.0))
    return np.round(10.0 * y / max(step, 1e-6)) * max(step, 1e-6)


@pytest.mark.parametrize("step", [0.0, 0.1, 0.5, 1.0, 2.0, 4.0])
def test_no_measurement_is_taken_for_a_repeat(step: float):
    rows = np.arange(3000)
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        moves = np.cumsum(rows // int(rng.integers(100, 300)) % 2)
        courses = {
            "walk": walk(rng, 3000, 0.02, step),
            "fast": walk(rng, 3000, 2.0, step),
            "rest": walk(rng, 3000, 0.0, step) * 0.3,
            "sine": np.round(10.0 * np.sin(rows / 9.1) / max(step, 0.01)) * max(step, 0.01),
            "stops": np.round(10.0 * np.sin(moves / 13.7) / max(step, 0.01)) * max(step, 0.01),
            "ramp": np.floor(rows / 17.0),
            "noisy ramp": np.floor(rows / 50.0 + rng.normal(0.0, 0.03, 3000)),
            "toggle": np.floor(rows / 10.0) % 2,
            "smooth": smooth(rng, step),
            "spikes": np.where(rng.uniform(size=3000) < 0.02, 50.0, np.round(rng.normal(0.0, 0.1, 3000))),
            "code": np.round(np.round(20.0 + rng.normal(0.0, 0.4, 3000)) * 0.0977, 3),
        }
        for name, y in courses.items():
            assert found(y).kind in (SINGLE, UNDECIDED), (name, seed)
        if step <= 2.0:
            assert found(courses["walk"]).kind == SINGLE


def test_constant_steps_dead_bands_and_lines_have_their_names():
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        assert found(np.repeat(walk(rng, 200, 0.2, 0.1), rng.geometric(0.1, 200) + 1)).kind == STEPS
        sent = [0.0]
        for value in walk(rng, 4000, 0.05, 0.01):
            sent.append(value if abs(value - sent[-1]) >= 3.0 else sent[-1])
        assert found(np.array(sent)).kind == DEAD_BAND
        knots = walk(rng, 150, 0.2, 0.1)
        for decimals in (4, 1):
            line = found(np.round(np.interp(np.arange(1491) / 10.0, np.arange(150), knots), decimals))
            assert (line.kind, round(line.period, 6)) == (LINEAR, 10.0)


def test_few_changes_are_undecided():
    assert found(np.repeat([0.0, 1.0, 5.0], 100)).reason == "fewer than 15 changes"


RULES = {None: [0, 1, 2, 3, 4, 5, 6, 7, 8], 0.0: [0, 2, 4, 6, 8], 2.0: [0, 2, 4, 5, 6, 7, 8]}
"""Rows that are measurements, by the period, of [5, 5, 6, 6, 5, 5, NaN, 5 much later, 7 at an earlier time]."""


@pytest.mark.parametrize("period", list(RULES))
@pytest.mark.parametrize("sizes", [[9], [1] * 9, [2, 4, 3], [5, 1, 3]])
def test_pieces_of_any_size_keep_the_same_rows(period, sizes: list[int]):
    counts: dict[str, int] = {}
    mapping = ChannelMapping(
        [([Channel(READING, 0, "T", ("T",), repeats=period)], ["T"], [None])],
        width=1,
        report=lambda key, text: counts.update({key: counts.get(key, 0) + 1}),
    )
    t = np.array([0, 1, 2, 3, 4, 6, 7, 100, 99]) * 10**9
    y = np.array([5, 5, 6, 6, 5, 5, np.nan, 5, 7], float)[:, None]
    kept, at = [], 0
    for size in sizes:
        part = slice(at, at + size)
        zeros = np.zeros(size, np.int64)
        state = np.full((size, 1), PRESENT, np.int8)
        events, row = mapping.events(zeros, t[part], t[part], y[part], state, zeros.astype(np.int8))
        np.testing.assert_array_equal(events.value[:, 0], y[part][row, 0])
        kept += (row + at).tolist()
        at += size
    assert kept == RULES[period]
    assert counts == ({} if period is None else {"repeats T": 9 - len(kept)})


def test_assets_of_a_fleet_have_holds_of_their_own():
    messages = Messages([Channel(READING, 0, "T", ("T",), repeats=0.0)], width=1, assets=True)
    sent = [("a", 1.0), ("b", 2.0), ("a", 1.0), ("b", 1.0), ("a", 3.0), ("b", 1.0)]
    messages.send([{"asset": asset, "values": {"T": value}} for asset, value in sent])
    found = messages.read(1.0)
    names = [found.names[code] for code in found.code]
    kept = list(zip(names, found.events.value[:, 0].tolist(), strict=True))
    assert kept == [("a", 1.0), ("b", 2.0), ("b", 1.0), ("a", 3.0)]
