"""The corridor: beams against a march through the rooms, its symmetry and its door, and what the filters make of it."""

import numpy as np
import pytest

from estimators.compiled.model import compile_model
from estimators.fold import Fold
from estimators.log import TRUTH, Log, truth_of
from estimators.models.agv_corridor import AGV_CORRIDOR, OUTLINE, WALLS
from estimators.tuning import Tuning
from tests.skips import recorded
from tests.support import folded

ROOMS = ((-24, 24, -1.5, 1.5), (-12, -10, -3, -1.5), (10, 12, 1.5, 3), (-5.2, -4, 1.5, 3))
"""The building as rectangles, west, east, south and north: corridor, two alcoves, door."""

STEP = 4e-3


def scanned(x):
    out = np.empty(4)
    compile_model(AGV_CORRIDOR).h[0](np.asarray(x, float), np.zeros(2), np.zeros(0), out)
    return out


def turned(x):
    return np.array([-x[0], -x[1], x[2] + np.pi])


def marched(x):
    """How far each beam gets before it leaves all rooms, found step by step."""
    along = np.arange(0.0, 60.0, STEP)
    found = []
    for k in range(4):
        angle = x[2] + k * np.pi / 2
        east, north = x[0] + along * np.cos(angle), x[1] + along * np.sin(angle)
        inside = np.zeros(along.size, bool)
        for west, end, south, top in ROOMS:
            inside |= (east >= west) & (east <= end) & (north >= south) & (north <= top)
        found.append(along[np.argmin(inside)])
    return np.array(found)


def test_beams_end_where_a_march_leaves_the_rooms():
    """A march may step over a corner by at most its step, so only beams that graze one may differ: hardly any."""
    rng = np.random.default_rng(2)
    x = np.column_stack((rng.uniform(-24, 24, 150), rng.uniform(-1.5, 1.5, 150), rng.uniform(-np.pi, np.pi, 150)))
    x[:30, 0] = rng.uniform(-6, -3, 30)  # around the door
    miss = np.array([np.abs(scanned(row) - marched(row)) for row in x])
    assert np.mean(miss > STEP) < 0.01
    assert np.median(miss) < STEP


def test_walls_are_parallel_to_the_axes_and_close_the_building():
    assert len(WALLS) == len(OUTLINE)
    assert np.all((WALLS[:, 0] == WALLS[:, 2]) != (WALLS[:, 1] == WALLS[:, 3]))
    np.testing.assert_array_equal(WALLS[:, 2:], np.roll(WALLS[:, :2], -1, axis=0))


def test_half_a_turn_is_seen_at_the_door_and_nowhere_else():
    """Beams across the corridor, from places where none meets the door or the place that faces it half a turn on."""
    rng = np.random.default_rng(3)
    for east in (*rng.uniform(-23, -6, 20), *rng.uniform(-3, 3, 20), *rng.uniform(6, 23, 20)):
        x = np.array([east, rng.uniform(-1, 1), rng.choice([0.0, np.pi]) + rng.uniform(-0.02, 0.02)])
        np.testing.assert_allclose(scanned(x), scanned(turned(x)), rtol=0, atol=1e-9)
    door = np.array([-4.6, 0.3, np.pi])
    np.testing.assert_allclose(scanned(door) - scanned(turned(door)), [0, 0, 0, 1.5], atol=1e-9)


def test_slopes_of_beams_match_central_differences():
    slopes = AGV_CORRIDOR.sensors[0].H
    rng = np.random.default_rng(4)
    step = 1e-6
    checked = 0
    for _ in range(60):
        x = np.array([rng.uniform(-23, 23), rng.uniform(-1.4, 1.4), rng.uniform(-np.pi, np.pi)])
        H = np.zeros((4, 3))
        slopes(x, np.zeros(2), np.zeros(0), H)
        ends = np.array([[scanned(x + sign * step * e) for e in np.eye(3)] for sign in (1, -1)])
        if np.abs(ends[0] - ends[1]).max() > 0.1:
            continue  # a beam that steps off a corner has no slope
        # The third derivative grows as d / cos⁴; with cos ≥ 0.03 and this step it stays under 1e-5 of the slope.
        np.testing.assert_allclose((ends[0] - ends[1]).T / (2 * step), H, rtol=1e-4, atol=1e-6)
        checked += 1
    assert checked > 50


@pytest.fixture(scope="module")
def drive():
    twin, log = recorded("agv_corridor")
    return twin, log


def unasked(log):
    """The log without its truths: queries, which change nothing and cost a copy and a prediction of all particles."""
    events = log.events
    other = Log(log.width, log.n)
    other.extend(events.select(events.kind != TRUTH))
    return other


def places(fold, seconds):
    """Weight of the peaks by the side of the building, east 1 and west -1, after so many seconds."""
    events = fold.log.events
    fold.advance(int(np.searchsorted(events.t - events.t[0], seconds * 1e9, side="right")) - fold.n)
    found = {1: 0.0, -1: 0.0}
    for mode in fold.peaks():
        found[int(np.sign(mode.mean[0]))] += mode.weight
    return found


@pytest.mark.parametrize("estimator", ["pf", "pf-reg"])
def test_particles_keep_both_peaks_until_the_door_and_then_settle(drive, estimator):
    """Until 18 s, when the turned vehicle passes the place where it would see the door, both peaks are as good.

    Resampling moves weight between equal peaks at random, first of all where few of the prior's particles fit the first
    scan; a tenth is what the lighter one keeps at least. Afterwards a peak that should see a room 1.5 m deep, and does
    not, twice at 0.5 m, is left with exp(-1.5² / 0.5²) = 1e-4.
    """
    twin, log = drive
    fold = Fold(estimator, twin.model, Tuning.of(twin.model).with_options(twin.options_of(estimator)), unasked(log))
    for seconds in (4, 8, 15):
        assert min(places(fold, seconds).values()) > 0.1
    places(fold, 40)
    (mode,) = fold.peaks()
    truth = np.array([truth_of(log.events, k)[1][-1] for k in range(3)])
    # The posterior's own spread: 4 standard deviations.
    miss = np.abs((mode.mean - truth + np.pi) % (2 * np.pi) - np.pi)
    assert (miss < 4 * np.sqrt(np.diag(mode.cov))).all(), f"{mode.mean} and {truth}"


def narrow(**overrides):
    twin, log = recorded("agv_corridor", overrides=overrides)
    return twin, log


def test_told_roughly_where_it_heads_the_ekf_chooses_that_peak_and_is_sure():
    """The heading is believed to be 0 ± 0.3, which is the other peak's: the door comes and goes, and it stays."""
    twin, log = narrow(**{"prior.heading.mean": "0.0", "prior.heading.std": "0.3"})
    fold = folded("ekf", twin.model, log)
    rows, east = truth_of(log.events, 0)
    at = np.searchsorted(log.events.t[rows], 15e9)
    for k in (at, -1):
        assert fold.track.std[rows[k], 0] < 0.5
        assert abs(fold.track.mean[rows[k], 0] - east[k]) > 10 * fold.track.std[rows[k], 0]
        assert np.sign(fold.track.mean[rows[k], 0]) == -np.sign(east[k])
