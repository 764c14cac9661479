"""Ensemble filters against Kalman's update of their sample moments, dense analyses, and the joint Gaussian."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.ensemble import analysis, localisation, shared
from estimators.ensemble.localisation import gaspari_cohn
from estimators.fold import Fold
from estimators.log import READING, Log
from estimators.model.state_space import Field, Noise, Row, Sensor, State, StateSpaceModel
from estimators.models.lorenz import LORENZ96
from estimators.numerics.random import key_of, normal
from estimators.tuning import Tuning
from tests.estimators.linear_models import ROWS, JointGaussian, kalman, random_linear, random_log
from tests.models import first_state, unchanged
from tests.support import folded, log_of

NAMES = ["enkf", "etkf", "ensrf", "letkf"]
EXACT = ["etkf", "ensrf", "letkf"]
LOCAL = ["enkf", "ensrf", "letkf"]
MATRICES = random_linear(np.random.default_rng(3), 4, 1)


def members_of(fold):
    N = int(fold.options["members"])
    return fold._now.state[: N * fold.model.nx].reshape(N, fold.model.nx).copy()


def analysed(name, model, options, sensor, y, seed=0):
    """Members before and after one reading at the time of the prior, and the fold."""
    tuning = replace(Tuning.of(model).with_options(options), seed=seed)
    fold = Fold(name, model, tuning, log_of(model.width, (0, READING, y, sensor)))
    before = members_of(fold)
    fold.advance()
    return before, members_of(fold), fold


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("members", [2, 3, 5, 40])
@pytest.mark.parametrize("sensor", [0, 1, 2])
@pytest.mark.parametrize("rotation", [0, 1])
def test_square_root_filters_are_kalmans_update_of_the_sample_moments(name, members, sensor, rotation):
    """An identity, for one row and several, with fewer members than rows and with more; rounding alone is between."""
    options = {"members": members, "rotation": rotation}
    y = np.array([1.3, -0.4, 2.2])[: ROWS[sensor]]
    before, after, fold = analysed(name, MATRICES.model, options, sensor, y)
    H, offset, R = MATRICES.H[sensor], MATRICES.D[sensor] @ MATRICES.u, np.diag(MATRICES.R[sensor])
    mean, P, nis, log_likelihood, _ = kalman(before.mean(0), np.cov(before.T), H, offset, R, y)
    np.testing.assert_allclose(after.mean(0), mean, rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.cov(after.T), P, rtol=0, atol=1e-10)
    assert fold.track.nis[0] == pytest.approx(nis, rel=1e-10)
    assert fold.track.log_likelihood[0] == pytest.approx(log_likelihood, rel=1e-10)
    np.testing.assert_allclose(fold.track.mean[0], mean, rtol=0, atol=1e-10)
    np.testing.assert_allclose(fold.track.std[0], np.sqrt(np.diag(P)), rtol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_members_start_about_the_priors_mean_exactly(name):
    fold = Fold(name, MATRICES.model, Tuning.of(MATRICES.model).with_options({"members": 5}), Log(MATRICES.model.width))
    np.testing.assert_allclose(members_of(fold).mean(0), MATRICES.mean, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("name", "local"), [*((name, {}) for name in EXACT), ("ensrf", {"radius": 4.0}), ("letkf", {"radius": 4.0})]
)
def test_rotation_turns_all_states_alike(name, local):
    """Anomalies after it are Ω times those before it, with one orthogonal Ω of all states that keeps the mean."""
    model = LORENZ96
    y = model.prior_mean[: len(model.sensors[0].rows)] + 0.7
    options = {"members": 12, **local}
    _, plain, _ = analysed(name, model, options, 0, y)
    _, turned, _ = analysed(name, model, options | {"rotation": 1}, 0, y)
    np.testing.assert_allclose(turned.mean(0), plain.mean(0), rtol=0, atol=1e-11)
    A, B = plain - plain.mean(0), turned - turned.mean(0)
    np.testing.assert_allclose(B.T @ B, A.T @ A, rtol=0, atol=1e-9)
    # Twelve members of forty states: their anomalies give Ω but for the ones, which it leaves. A has rank 11; its last
    # singular value is rounding, which lies at the default limit of pinv (1e-15 of the largest) on some processors.
    Omega = B @ np.linalg.pinv(A, rcond=1e-10) + np.full((12, 12), 1 / 12)
    np.testing.assert_allclose(Omega @ Omega.T, np.eye(12), rtol=0, atol=1e-8)
    np.testing.assert_allclose(Omega.sum(axis=0), 1.0, rtol=0, atol=1e-8)
    assert np.max(np.abs(Omega - np.eye(12))) > 0.1


@pytest.mark.parametrize("members", [3, 5, 40])
@pytest.mark.parametrize("sensor", [0, 2])
def test_enkf_moves_the_mean_as_kalman_does_and_each_member_by_its_own_reading(members, sensor):
    y = np.array([1.3, -0.4, 2.2])[: ROWS[sensor]]
    before, after, fold = analysed("enkf", MATRICES.model, {"members": members}, sensor, y)
    H, R = MATRICES.H[sensor], np.diag(MATRICES.R[sensor])
    offset = MATRICES.D[sensor] @ MATRICES.u
    mean, _, nis, *_ = kalman(before.mean(0), np.cov(before.T), H, offset, R, y)
    np.testing.assert_allclose(after.mean(0), mean, rtol=0, atol=1e-10)
    assert fold.track.nis[0] == pytest.approx(nis, rel=1e-10)
    v = perturbations(members, y.size) * np.sqrt(MATRICES.R[sensor])
    P = np.cov(before.T)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    np.testing.assert_allclose(after, before + (y + v - before @ H.T - offset) @ K.T, rtol=0, atol=1e-10)


def perturbations(members, m):
    """The filter's own draws for event 0, centred: their sample variance, over N - 1, is 1 on average as it is."""
    key = np.uint64(key_of(0, 1, shared.PERTURB))  # the first that is drawn
    z = np.array([[normal(key, np.uint64(k * members + i)) for k in range(m)] for i in range(members)])
    return z - z.mean(0)


@pytest.mark.parametrize("name", NAMES)
def test_error_against_the_joint_gaussian_falls_as_one_over_root_n(name):
    """A log of 30 events, with lost rows. An estimate from N draws is off by c σ / √N, c of order 1 (√2 for variances).

    Over 12 seeds the RMS of the error, in posterior standard deviations and times √N, has a spread of about
    1/√(2·12·4) = 10 %; c is bounded by 3, because gains of earlier readings carry sampling errors on, and its ratio
    between two N must be 1 within four of those spreads.
    """
    log = random_log(np.random.default_rng(5), MATRICES, 30)
    mean, cov = JointGaussian(MATRICES, log).filtered(log.n - 1, np.ones(3, bool))
    std = np.sqrt(np.diag(cov))
    scaled = []
    for members in (50, 800):
        errors = []
        for seed in range(12):
            tuning = Tuning.of(MATRICES.model).with_options({"members": members})
            fold = folded(name, MATRICES.model, log, replace(tuning, seed=seed))
            found, found_cov = fold.moments()
            errors.append(np.concatenate(((found - mean) / std, (np.diag(found_cov) / std**2 - 1) / np.sqrt(2))))
        scaled.append(np.sqrt(np.mean(np.square(errors)) * members))
    assert all(0.1 < value < 3.0 for value in scaled), scaled
    assert 0.6 < scaled[0] / scaled[1] < 1.6, scaled


@pytest.mark.parametrize("name", NAMES)
def test_what_is_gated_or_held_out_moves_no_member(name):
    model = MATRICES.model
    before, _, _ = analysed(name, model, {"members": 30}, 2, [1.0, np.nan, -0.5])
    for tuning in (Tuning.of(model).set("gate", 0.5), Tuning.of(model).set("use.third", False)):
        far = log_of(model.width, (0, READING, [1e3, 1e3, 1e3], 2))
        refused = folded(name, model, far, tuning.with_options({"members": 30}))
        np.testing.assert_array_equal(members_of(refused), before)


@pytest.mark.parametrize("name", NAMES)
def test_inflation_widens_and_additive_noise_keeps_the_mean(name):
    y = np.array([0.7])
    _, plain, _ = analysed(name, MATRICES.model, {"members": 20}, 0, y)
    _, wide, _ = analysed(name, MATRICES.model, {"members": 20, "inflation": 1.3}, 0, y)
    mean = plain.mean(0)
    np.testing.assert_allclose(wide, mean + 1.3 * (plain - mean), rtol=0, atol=1e-12)
    _, noisy, _ = analysed(name, MATRICES.model, {"members": 2000, "additive": 0.5}, 0, y)
    _, bare, _ = analysed(name, MATRICES.model, {"members": 2000}, 0, y)
    np.testing.assert_allclose(noisy.mean(0), bare.mean(0), rtol=0, atol=1e-12)
    added = (noisy - bare).std(0) / MATRICES.std
    np.testing.assert_allclose(added, 0.5, rtol=4 / np.sqrt(2 * 1000))  # 1000 independent pairs, four sigma


# Localisation: a ring of 40 states of which a sensor reads 9, two of them lost, and a reading of one dense oracle each.

READ = (0, 3, 7, 8, 15, 21, 22, 30, 38)


def some(x, u, p, out):
    for k in range(out.size):
        out[k] = x[READ[k]]


RING = StateSpaceModel(
    name="ring",
    title="ring",
    states=Field("x", "1", (40,), spacing=0.5, periodic=(True,), std=2.0),
    noises=(Noise("x", "1/s", 0.1),),
    sensors=(Sensor("some", tuple(Row(f"r{k}", "1", 0.5, position=(0.5 * k,)) for k in READ), h=some),),
    f=unchanged,
)
Y = np.array([1.0, 2.0, -1.0, np.nan, 3.0, 0.5, -2.0, np.nan, 1.5])
SEEN = np.flatnonzero(np.isfinite(Y))


def ring_taper(a, b, length, radius):
    """By brute force: over all ways round a circle that may be within the radius, relative to distance 0."""
    turns = length * np.arange(-20, 21)
    total = gaspari_cohn(np.abs((a[:, None] - b[None])[..., None] + turns), radius).sum(-1)
    return total / gaspari_cohn(np.abs(turns), radius).sum()


def shortest_taper(a, b, length, radius):
    """By brute force too, of the shortest of these ways."""
    ways = (a[:, None] - b[None])[..., None] + length * np.arange(-20, 21)
    return gaspari_cohn(np.abs(ways).min(-1), radius)


def ring_tapers(radius, taper=ring_taper):
    """Between states and rows, and between rows, on a circle of length 20."""
    at, rows = 0.5 * np.arange(40), 0.5 * np.array(READ)[SEEN]
    return taper(at, rows, 20.0, radius), ring_taper(rows, rows, 20.0, radius)


def dense_enkf(X, y, v, H, r, to_states, between):
    P = np.cov(X.T)
    C = P @ H.T * to_states
    S = H @ P @ H.T * between + r * np.eye(y.size)
    return X + (y + v - X @ H.T) @ np.linalg.solve(S, C.T)


def dense_ensrf(X, y, v, H, r, to_states, between):
    """Serially on the states with the rows appended, as Whitaker and Hamill write it."""
    N, n = X.shape
    joint = np.hstack((X, X @ H.T))
    taper = np.vstack((to_states, between))
    for k in range(y.size):
        mean, A = joint.mean(0), joint - joint.mean(0)
        hx = A[:, n + k]
        s = hx @ hx / (N - 1) + r
        K = taper[:, k] * (A.T @ hx) / (N - 1) / s
        alpha = 1 / (1 + np.sqrt(r / s))
        joint = mean + K * (y[k] - mean[n + k]) + A - alpha * np.outer(hx, K)
    return joint[:, :n]


def dense_letkf(X, y, v, H, r, to_states, between):
    """As Hunt, Kostelich and Szunyogh write it, state by state, with R divided by the taper."""
    N, n = X.shape
    Yb, d = (X - X.mean(0)) @ H.T, y - X.mean(0) @ H.T
    out = X.copy()
    for j in range(n):
        near = to_states[j] > 0
        if near.any():
            C = Yb[:, near] * (to_states[j, near] / r)
            values, vectors = np.linalg.eigh((N - 1) * np.eye(N) + C @ Yb[:, near].T)
            Pa = vectors / values @ vectors.T
            W = vectors * np.sqrt((N - 1) / values) @ vectors.T
            out[:, j] = X[:, j].mean() + (X[:, j] - X[:, j].mean()) @ (W + (Pa @ C @ d[near])[:, None])
    return out


@pytest.mark.parametrize(("name", "dense"), [("enkf", dense_enkf), ("ensrf", dense_ensrf), ("letkf", dense_letkf)])
@pytest.mark.parametrize("radius", [0.6, 4.0, 9.0, 13.0, 19.9, 41.0, 150.0])
@pytest.mark.parametrize("members", [4, 12])
def test_localised_analyses_equal_dense_ones(name, dense, radius, members):
    before, after, _ = analysed(name, RING, {"members": members, "radius": radius}, 0, Y)
    H = np.eye(40)[list(READ)][SEEN]
    v = perturbations(members, SEEN.size) * np.sqrt(0.5)
    tapers = ring_tapers(radius, shortest_taper if name == "letkf" else ring_taper)
    expected = dense(before, Y[SEEN], v, H, 0.5, *tapers)
    np.testing.assert_allclose(after, expected, rtol=0, atol=1e-10)
    assert np.max(np.abs(after - before)) > 0.1
    far = ~(tapers[0] > 0).any(1)
    np.testing.assert_allclose(after[:, far], before[:, far], rtol=0, atol=1e-14)


@pytest.mark.parametrize("members", [2, 5, 19, 33])
@pytest.mark.parametrize("radius", [2.5, 9.0, 19.9, 31.0, 39.0, 85.0])
def test_letkf_of_many_rows_equals_a_dense_one(members, radius):
    """40 rows, of which 5, 17, 39 or all are near a state: fewer than members, as many, and more; some are missing.

    With a radius beyond the way round, tapers by the short way alone make the innovation covariance indefinite: it has
    those of all ways, and the weights have these.

    Eigenvalues are up to some thousands, and relative rounding of dozens of ε is multiplied by them: 1e-10.
    """
    rng = np.random.default_rng(members)
    y = LORENZ96.prior_mean + rng.standard_normal(40)
    y[[4, 5, 31]] = np.nan
    seen = np.flatnonzero(np.isfinite(y))
    before, after, _ = analysed("letkf", LORENZ96, {"members": members, "radius": radius}, 0, y)
    tapers = shortest_taper(np.arange(40), seen, 40, radius)
    expected = dense_letkf(before, y[seen], None, np.eye(40)[seen], 1.0, tapers, None)
    np.testing.assert_allclose(after, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("radius", [3.0, 5.0, 5.5, 9.0, 26.0, 79.0])
@pytest.mark.parametrize("axes", [1, 2])
def test_tapers_of_rings_are_positive_definite_at_any_radius(axes, radius):
    """By brute force, on a cylinder or a torus of 10 by 12, with places several turns away."""
    periods = np.array([10.0, 12.0 if axes == 2 else np.inf])
    rng = np.random.default_rng(axes)
    places = rng.uniform(0.0, 12.0, (60, 2))
    turned = places + np.where(np.isfinite(periods), rng.integers(-3, 4, (60, 2)), 0) * np.array([10.0, 12.0])
    found = localisation.taper_between(turned[:, None], places[None], periods, radius)
    shifts = [np.arange(-20, 21) * length if np.isfinite(length) else np.zeros(1) for length in periods]
    ways = np.stack(np.meshgrid(*shifts, indexing="ij"), -1).reshape(-1, 2)
    apart = places[:, None] - places[None]
    at_0 = gaspari_cohn(np.linalg.norm(ways, axis=-1), radius).sum()
    expected = sum(gaspari_cohn(np.linalg.norm(apart + way, axis=-1), radius) for way in ways) / at_0
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    assert np.linalg.eigvalsh(found).min() > -1e-12


@pytest.mark.parametrize("members", [2, 7, 14, 15, 40])
@pytest.mark.parametrize("inflation", [1.0, 1.2])
def test_ensrf_without_radius_is_serial(members, inflation):
    """Members, not only moments: 7 rows one after the other on all states, where a transform replaces them and not.

    Rounding of 7 rows and up to 40 members, in numbers of order 1: within 1e-12.
    """
    before, after, _ = analysed("ensrf", RING, {"members": members, "inflation": inflation}, 0, Y)
    H = np.eye(40)[list(READ)][SEEN]
    expected = dense_ensrf(before, Y[SEEN], None, H, 0.5, np.ones((40, SEEN.size)), np.ones((SEEN.size, SEEN.size)))
    mean = expected.mean(0)
    np.testing.assert_allclose(after, mean + inflation * (expected - mean), rtol=0, atol=1e-12)


def near_the_end(x, u, p, out):
    out[0] = x[36]


@pytest.mark.parametrize("name", LOCAL)
def test_a_reading_moves_the_states_that_it_reaches_and_no_others(name):
    """The first block of 32 states is not among them."""
    sensor = Sensor("end", (Row("r36", "1", 0.5, position=(18.0,)),), h=near_the_end)
    before, after, _ = analysed(name, replace(RING, sensors=(sensor,)), {"members": 8, "radius": 0.6}, 0, [3.0])
    moved = np.flatnonzero(np.max(np.abs(after - before), axis=0) > 1e-12)
    assert 36 in moved and np.all(np.abs(0.5 * moved - 18.0) < 2 * 0.6)


@pytest.mark.parametrize("name", LOCAL)
def test_a_radius_without_end_is_no_radius(name):
    """At 1e8 times the domain the taper is 1 to rounding; so letkf, worked out state by state, is etkf."""
    for members in (4, 12):
        _, local, near = analysed(name, RING, {"members": members, "radius": 1e9}, 0, Y)
        _, plain, far = analysed(name, RING, {"members": members}, 0, Y)
        np.testing.assert_allclose(local, plain, rtol=0, atol=1e-10)
        assert near.track.nis[0] == pytest.approx(far.track.nis[0], rel=1e-10)
        if name == "letkf":
            _, turned, _ = analysed("etkf", RING, {"members": members}, 0, Y)
            np.testing.assert_allclose(local, turned, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", ["ensrf", "letkf"])
def test_localised_inflation_acts_where_the_reading_does(name):
    _, plain, _ = analysed(name, RING, {"members": 8, "radius": 2.0}, 0, Y)
    _, wide, _ = analysed(name, RING, {"members": 8, "radius": 2.0, "inflation": 1.5}, 0, Y)
    factor = 1 + 0.5 * ring_tapers(2.0)[0].max(1)
    mean = plain.mean(0)
    np.testing.assert_allclose(wide, mean + factor * (plain - mean), rtol=0, atol=1e-12)


def test_gaspari_cohn_is_their_function():
    """Values of equation 4.10 at z = 0, 1/2, 1, 3/2, 2 as fractions; positive definite; flat at both ends."""
    values = gaspari_cohn(np.array([0.0, 0.25, 0.5, 0.75, 1.0, 2.0]), 1.0)
    z = 0.5
    half = -(z**5) / 4 + z**4 / 2 + 5 * z**3 / 8 - 5 * z**2 / 3 + 1
    z = 1.5
    late = z**5 / 12 - z**4 / 2 + 5 * z**3 / 8 + 5 * z**2 / 3 - 5 * z + 4 - 2 / (3 * z)
    np.testing.assert_allclose(values, [1.0, half, 5 / 24, late, 0.0, 0.0], atol=1e-15)
    places = np.random.default_rng(0).uniform(0, 3, (60, 3))
    distance = np.linalg.norm(places[:, None] - places[None], axis=-1)
    assert np.linalg.eigvalsh(gaspari_cohn(distance, 2.0)).min() > -1e-12


@pytest.mark.parametrize("name", NAMES)
def test_bits_are_the_same_on_any_number_of_threads(name, monkeypatch):
    rng = np.random.default_rng(2)
    log = log_of(40, *((0.05 * k, READING, rng.normal(2, 4, 40)) for k in range(6)))
    options = {"members": 11, "inflation": 1.02, "additive": 0.01} | ({} if name == "etkf" else {"radius": 8.0})
    states = []
    for crews in (1, 2, 5):
        for module in (shared, analysis):
            monkeypatch.setattr(module, "crews", lambda numbers, start, crews=crews: crews)
        fold = folded(name, LORENZ96, log, options=options)
        states.append(fold._now.state.copy())
    assert localisation.threaded()
    np.testing.assert_array_equal(states[0], states[1])
    np.testing.assert_array_equal(states[0], states[2])


# Angles: an angle near the seam, read by a sensor of which the row is an angle too.


COMPASS = StateSpaceModel(
    name="compass",
    title="compass",
    states=(State("heading", "rad", mean=3.1, std=0.2, circular=True),),
    noises=(Noise("heading", "rad²/s", 1e-4),),
    sensors=(Sensor("bearing", (Row("bearing", "rad", 0.04, circular=True),), h=first_state),),
    f=unchanged,
)


@pytest.mark.parametrize("name", NAMES)
def test_angles_do_not_tear(name):
    """The same as on a line whose seam is elsewhere: prior 3.1 ± 0.2, reading -3.1, that is 3.183, ± 0.2."""
    before, after, fold = analysed(name, COMPASS, {"members": 400}, 0, [-3.1])
    P = np.var(before, ddof=1)
    mean = before.mean() + P / (P + 0.04) * (2 * np.pi - 3.1 - before.mean())
    assert fold.track.innovation[0, 0] == pytest.approx(2 * np.pi - 3.1 - before.mean(), abs=1e-12)
    assert (after.mean() - mean + np.pi) % (2 * np.pi) - np.pi == pytest.approx(0.0, abs=1e-10)
    assert -np.pi <= fold.track.mean[0, 0] < np.pi
    assert np.max(np.abs(after - after.mean())) < 1.0
