"""On linear models every smoothed Gaussian filter equals a dense joint Gaussian over all states, in one solve.

Tolerance 1e-9, relative to the size of the quantity, as for the filters (gaussian/test_joint_gaussian.py).
"""

import numpy as np
import pytest
from scipy.linalg import block_diag

from estimators.errors import EstimatorError
from estimators.events.maintenance import maintained
from estimators.fold import Fold
from estimators.log import READING, RESET, TICK, Events
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.registry import ESTIMATORS
from estimators.smoothing import moments_back, walk
from estimators.smoothing.smooth import smooth
from estimators.track import GATED
from estimators.tuning import Tuning
from tests.estimators.linear_models import CORRELATED, JointGaussian, case, close, random_linear, random_log
from tests.models import constant_speed, first_state
from tests.support import SECOND, as_log, assert_same, folded

GAUSSIAN = [entry.name for entry in ESTIMATORS.values() if entry.smoothing and entry.family == "Gaussian"]
CASES = [(nx, nu, seed) for nx, nu in ((1, 0), (3, 2), (5, 1)) for seed in (0, CORRELATED)]


def pairs_of(nx):
    return np.stack(np.triu_indices(nx, 1), axis=1)


def moments(smoothed, nx):
    """Means (N, nx) and covariances (N, nx, nx) of what was smoothed with all pairs."""
    cov = np.empty((len(smoothed.mean), nx, nx))
    cov[:, range(nx), range(nx)] = smoothed.std**2
    i, j = np.triu_indices(nx, 1)
    cov[:, i, j] = cov[:, j, i] = smoothed.cross
    return smoothed.mean, cov


def smoothed_by(estimator, model, tuning, log):
    fold = folded(estimator, model, log, tuning, pairs=pairs_of(model.nx))
    return moments(smooth(fold), model.nx)


def agree(found, expected):
    for mine, exact, name in zip(found, expected, ("mean", "covariance"), strict=True):
        close(mine, exact, name)


@pytest.mark.parametrize("estimator", GAUSSIAN)
@pytest.mark.parametrize(("nx", "nu", "seed"), CASES)
def test_smoothed_moments(estimator, nx, nu, seed):
    matrices, log, joint = case(nx, nu, seed)
    found = smoothed_by(estimator, matrices.model, Tuning.of(matrices.model), log)
    agree(found, joint.smoothed(np.ones(3, bool)))


@pytest.mark.parametrize("estimator", GAUSSIAN)
def test_a_sensor_held_out_says_nothing(estimator):
    matrices, log, joint = case(3, 2, 0)
    found = smoothed_by(estimator, matrices.model, Tuning.of(matrices.model).set("use.second", False), log)
    agree(found, joint.smoothed(np.array([True, False, True])))


@pytest.mark.parametrize("estimator", [name for name in GAUSSIAN if ESTIMATORS[name].singular])
def test_states_that_are_certain_at_first(estimator):
    rng = np.random.default_rng(7)
    matrices = random_linear(rng, 3, 1, certain=True)
    log = random_log(rng, matrices, events=40)
    found = smoothed_by(estimator, matrices.model, Tuning.of(matrices.model), log)
    agree(found, JointGaussian(matrices, log).smoothed(np.ones(3, bool)))


# A body that moves at a speed which wanders: F and Q of two steps are those of one, so that queries between two
# readings, steps no longer than the model allows, and the dense solution speak of the same process.


def Q(x, u, p, q, dt, out):
    out[0, 0] = q[0] * dt**3 / 3.0
    out[0, 1] = out[1, 0] = q[0] * dt**2 / 2.0
    out[1, 1] = q[0] * dt


VARIANCE, START = 0.25, (np.array([1.0, -0.5]), np.diag([4.0, 1.0]))
BODY = StateSpaceModel(
    name="body",
    title="a body whose speed wanders",
    states=(State("place", "m", mean=1.0, std=2.0), State("speed", "m/s", mean=-0.5, std=1.0)),
    noises=(Noise("push", "m²/s³", variance=0.3),),
    sensors=(Sensor("place", (Row("place", "m", variance=VARIANCE),), h=first_state),),
    f=constant_speed,
    Q=Q,
    linear=True,
    max_step=0.4,
)


def moved(dt):
    return np.array([[1.0, dt], [0.0, 1.0]]), 0.3 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])


class Chain:
    """States at times, one Gaussian: what joins them, and readings of the place. Solved at once."""

    def __init__(self, mean, cov):
        self._F, self._c, self._Q, self._read = [np.zeros((2, 2))], [mean], [cov], []

    def go_on(self, F, Q, c=(0.0, 0.0)):
        self._F.append(F)
        self._Q.append(Q)
        self._c.append(np.array(c))

    def read(self, y):
        self._read.append((len(self._F) - 1, y))

    def solved(self):
        K = len(self._F)
        M = np.eye(2 * K)
        for k in range(1, K):
            M[2 * k : 2 * k + 2, 2 * k - 2 : 2 * k] = -self._F[k]
        inverse = np.linalg.inv(M)
        mean, cov = inverse @ np.concatenate(self._c), inverse @ block_diag(*self._Q) @ inverse.T
        H = np.zeros((len(self._read), 2 * K))
        for i, (k, _) in enumerate(self._read):
            H[i, 2 * k] = 1.0
        S = H @ cov @ H.T + VARIANCE * np.eye(len(H))
        gain = np.linalg.solve(S, H @ cov).T
        mean = mean + gain @ (np.array([y for _, y in self._read]) - H @ mean)
        cov = cov - gain @ H @ cov
        return mean.reshape(-1, 2), np.array([cov[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(K)])


def body_log(events):
    return as_log(Events.concat(events, 1))


def reading(t, y):
    return Events.one(round(t * SECOND), 0, READING, 0, [y], 1)


def query(t):
    return Events.one(round(t * SECOND), 0, TICK, 0, [], 1)


TIMES = (0.0, 0.5, 0.5, 1.75, 3.0, 3.25)
PLACES = (0.7, 0.1, 0.4, -1.2, 0.3, 1.1)


@pytest.mark.parametrize("estimator", GAUSSIAN)
def test_queries_between_readings_and_steps_within(estimator):
    asked = (0.5, 0.6, 1.0, 1.0, 1.75, 2.9, 3.25, 4.0)
    events = [reading(t, y) for t, y in zip(TIMES, PLACES, strict=True)] + [query(t) for t in asked]
    log = body_log(events)
    chain, clock = Chain(*START), 0.0
    for t, kind, value in zip(log.events.t / SECOND, log.events.kind, log.events.value[:, 0], strict=True):
        chain.go_on(*moved(t - clock))
        clock = t
        if kind == READING:
            chain.read(value)
    agree(smoothed_by(estimator, BODY, Tuning.of(BODY), log), [each[1:] for each in chain.solved()])


@pytest.mark.parametrize("estimator", GAUSSIAN)
def test_a_reset_and_a_maintenance(estimator):
    """What comes after a reset says nothing of before; a part that was changed, nothing of the part before it."""
    changed, reset = 1.0, 2.0
    events = [reading(t, y) for t, y in zip(TIMES, PLACES, strict=True)]
    events += [maintained(round(changed * SECOND), 0, (1,), 1), query(0.8), query(1.0), query(1.2), query(1.9)]
    events += [Events.one(round(reset * SECOND), 0, RESET, 0, [], 1), query(2.5)]
    log = body_log(events)
    fold = folded(estimator, BODY, log)
    chains, clock = [Chain(*START)], 0.0
    for i in range(log.n):
        t = log.t[i] / SECOND
        if log.kind[i] == RESET:
            chains.append(Chain(*START))
        else:
            chains[-1].go_on(*moved(t - clock))
        if log.kind[i] == READING:
            chains[-1].read(log.value[i, 0])
        clock = t
        if t == changed and log.t[i + 1] > log.t[i]:
            # The filter keeps the mean of what it no longer knows.
            chains[-1].go_on(np.diag([1.0, 0.0]), np.diag([0.0, START[1][1, 1]]), (0.0, fold.track.mean[i, 1]))
    # Of the two states at the maintenance the row shows the later; the first is the prior.
    at = int(np.flatnonzero(log.events.t == changed * SECOND)[-1]) + 1
    pairs = zip(*(chain.solved() for chain in chains), strict=True)
    expected = [np.concatenate((np.delete(first, at, 0)[1:], second)) for first, second in pairs]
    agree(moments(smooth_with_pairs(estimator, log), 2), expected)


def smooth_with_pairs(estimator, log, tuning=None):
    fold = folded(estimator, BODY, log, tuning or Tuning.of(BODY), pairs=pairs_of(2))
    return smooth(fold)


def long_log(n=3000, seed=3, jump=0.0):
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.integers(1, 40, n)) * (SECOND // 100)
    y = np.cumsum(rng.normal(0, 0.3, n)) + np.where(np.arange(n) < n // 2, 0.0, jump)
    readings = Events.alike(READING, t, y)
    asked = readings.select(np.arange(0, n, 3))
    between = asked._replace(t=asked.t + SECOND // 300, kind=np.full(asked.t.size, TICK, np.int8))
    at = asked._replace(kind=np.full(asked.t.size, TICK, np.int8))
    return as_log(Events.concat([readings, between, at], 1))


@pytest.mark.parametrize("notes", [10_000, 1])
@pytest.mark.parametrize("estimator", ["kf", "sr-ukf"])
def test_the_memory_is_bounded_and_the_bits_are_the_same(estimator, notes, monkeypatch):
    log = long_log()
    whole = smooth_with_pairs(estimator, log)
    rooms = []
    made = moments_back.StepRecorder

    def noting(*given):
        rooms.append(given[-1])
        return made(*given)

    monkeypatch.setattr(moments_back, "StepRecorder", noting)
    monkeypatch.setattr(walk, "BATCH_BYTES", notes)
    assert_same(whole, smooth_with_pairs(estimator, log))
    assert rooms[0] < 100


def test_the_fold_stays_as_it_is():
    log = long_log(500)
    fold = folded("ukf", BODY, log, stop=300)
    before, state = fold.track.copy(), fold.moments()
    smooth(fold)
    assert_same(before, fold.track)
    for one, other in zip(state, fold.moments(), strict=True):
        np.testing.assert_array_equal(one, other)
    fold.advance()
    whole = folded("ukf", BODY, log)
    np.testing.assert_array_equal(whole.track.mean, fold.track.mean)


@pytest.mark.parametrize("estimator", ["ekf", "sr-kf"])
def test_a_twin_that_was_found_wrong(estimator):
    """The readings that were refused at first speak, and the widening before them lets the place jump."""
    log = long_log(400, jump=60.0)
    tuning = Tuning.of(BODY).set("gate", 0.999).set("gate.reopen", 3.0)
    fold = folded(estimator, BODY, log, tuning, pairs=pairs_of(2))
    (decision,) = [d for d in fold.decisions if d.outcome in ("reopened", "believed")]
    refused = np.flatnonzero(fold.track.verdict == GATED)
    assert decision.first == refused[0] and decision.row > refused[0] + 1
    story = fold.second_story(decision.first, decision.row + 1, 0)
    chain, clock = Chain(*START), log.t[0] / SECOND
    for i in range(log.n):
        t = log.t[i] / SECOND
        F, noise = moved(t - clock)
        if i == decision.first:
            noise = noise + F @ np.diag(story.widened**2) @ F.T
        chain.go_on(F, noise)
        if log.kind[i] == READING and (i not in refused or decision.first <= i <= decision.row):
            chain.read(log.value[i, 0])
        clock = t
    agree(moments(smooth(fold), 2), [each[1:] for each in chain.solved()])


def test_a_filter_without_a_smoother_is_refused():
    with pytest.raises(EstimatorError, match="filterpy-kf cannot be smoothed"):
        smooth(Fold("filterpy-kf", BODY, Tuning.of(BODY), long_log(10)))
