"""The gripper: its derivatives and chances, the simulated jumps, and who tells best whether it touches."""

from functools import lru_cache

import numpy as np
import pytest

from estimators.compiled.model import compile_model
from estimators.log import truth_of
from estimators.models.gripper_contact import CONTACT, DEPTH, GRIPPER_CONTACT, SURFACE, chances
from tests.skips import recorded
from tests.support import folded

P = GRIPPER_CONTACT.default_parameters
SEEDS = (1, 2, 3, 4)


@lru_cache
def contact(name, seed, particles=300, duration=15.0):
    """Estimates and truth of contact, of a filter over the twin's simulation, and the fold."""
    twin, log = recorded("gripper_contact", overrides={"source.seed": str(seed)}, duration=duration)
    tuning = twin.tuning.with_options({"particles": particles} if name in ("rbpf", "pf") else {})
    run = folded(name, twin.model, log, tuning)
    rows, truth = truth_of(log.events, CONTACT)
    return run.track.mean[rows, CONTACT], truth, run


def test_chances_over_two_half_steps_are_those_of_a_step():
    """The depth standing still, the jump is a Markov chain in continuous time: its two rates add up to λ."""
    for depth in (-1.0, -0.1, 0.0, 0.3):
        x = np.zeros(5)
        x[DEPTH] = depth
        steps = {}
        for dt in (1e-5, 2e-5):
            rows = []
            for mode in (0.0, 1.0):
                x[CONTACT] = mode
                out = np.empty(2)
                chances(x, np.zeros(1), P, dt, out)
                rows.append(out)
            steps[dt] = np.array(rows)
        # Two jumps within a step are left out: an error of (λ dt)² = 2.5e-7 at most.
        np.testing.assert_allclose(steps[1e-5] @ steps[1e-5], steps[2e-5], rtol=0, atol=5e-7)
        assert abs(steps[1e-5][0, 1] / 1e-5 + steps[1e-5][1, 0] / 1e-5 - 50.0) < 0.05


def test_a_pressed_finger_rests_where_the_pad_balances_the_drive():
    x, out = np.array([1.0, 0.5, 0.0, 40.0, 0.0]), np.empty(5)
    for _ in range(1000):
        compile_model(GRIPPER_CONTACT).f(x, np.array([0.4]), P, 0.01, out)
        x = out.copy()
    np.testing.assert_allclose(x, [1.0, 0.4 / 0.5, 0.0, 40.0, 0.0], atol=1e-9)


def test_a_slip_does_not_move_the_finger():
    Q = np.zeros((5, 5))
    compile_model(GRIPPER_CONTACT).Q(np.zeros(5), np.zeros(1), P, np.array([0.0, 1.0, 0.0]), 0.1, Q)
    position = np.zeros(5)
    position[[DEPTH, SURFACE]] = 1.0
    assert Q[DEPTH, DEPTH] == pytest.approx(0.1) and abs(position @ Q @ position) < 1e-15


def test_simulated_jumps_follow_the_chances():
    """How often each step's chances came true: the sum of (jump - chance) over its standard deviation is N(0, 1)."""
    twin, log = recorded("gripper_contact", overrides={"source.seed": "9"})
    states = np.array([truth_of(log.events, j)[1] for j in range(5)]).T
    assert set(np.unique(states[:, CONTACT])) == {0.0, 1.0}
    miss, variance = 0.0, 0.0
    for before, after in zip(states[:-1], states[1:], strict=True):
        out = np.empty(2)
        chances(before, np.zeros(1), P, 0.01, out)
        miss += after[CONTACT] - out[1]
        variance += out[0] * out[1]
    assert variance > 5.0 and abs(miss) < 4 * np.sqrt(variance)


def test_the_probability_of_contact_is_calibrated():
    """Where the filter says p, contact is there in p of the cases, give or take how few independent cases there are."""
    p, truth = (np.concatenate([contact("rbpf", seed)[k] for seed in SEEDS]) for k in (0, 1))
    assert p.min() >= 0.0 and p.max() <= 1.0
    assert np.mean(truth[p < 0.01]) < 0.005 and np.mean(truth[p > 0.99]) > 0.99
    middle = (p > 0.2) & (p < 0.8)
    # Neighbours of a doubtful stretch share its fate: some 10 stretches a run, each of standard deviation ≤ ½.
    assert abs(np.mean(truth[middle]) - np.mean(p[middle])) < 4 * 0.5 / np.sqrt(10 * len(SEEDS))
