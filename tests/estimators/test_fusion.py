"""Covariance intersection: against a numeric minimisation, and its bound for every correlation of the errors."""

import json

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from estimators import covariance_intersection, fuse
from estimators.errors import EstimatorError
from tests.cases import cases
from tests.support import error_of

FORMS = {"det": np.linalg.det, "trace": np.trace}


def covariance(rng, n):
    A = rng.normal(size=(n, n + 2)) * 10.0 ** rng.uniform(-1, 1, (n, 1))
    return A @ A.T / n


def gains(covs):
    """Gains (2, n, n) of both means, by the fusion of unit vectors."""
    n = covs.shape[1]
    found = np.empty((2, n, n))
    for k in range(2):
        for j in range(n):
            means = np.zeros((2, n))
            means[k, j] = 1.0
            found[k, :, j] = covariance_intersection(means, covs)[0]
    return found


@pytest.mark.parametrize("minimise", FORMS)
@pytest.mark.parametrize("n", [1, 2, 5])
def test_it_is_the_least_intersection(minimise, n):
    rng = np.random.default_rng(n)
    for _ in range(20):
        covs, means = np.stack([covariance(rng, n), covariance(rng, n)]), rng.normal(size=(2, n))
        I1, I2 = np.linalg.inv(covs)
        mean, cov, w = covariance_intersection(means, covs, minimise)

        def size(w, I1=I1, I2=I2):
            return FORMS[minimise](np.linalg.inv(w * I1 + (1.0 - w) * I2))

        best = min(size(0.0), size(1.0), minimize_scalar(size, bounds=(0.0, 1.0), method="bounded").fun)
        assert FORMS[minimise](cov) <= best * (1.0 + 1e-9)
        np.testing.assert_allclose(cov, np.linalg.inv(w * I1 + (1.0 - w) * I2), rtol=1e-8, atol=1e-10)
        expected = np.linalg.solve(w * I1 + (1.0 - w) * I2, w * I1 @ means[0] + (1.0 - w) * I2 @ means[1])
        np.testing.assert_allclose(mean, expected, rtol=1e-8, atol=1e-10)


def test_the_same_estimate_twice_is_not_more_certain():
    P = covariance(np.random.default_rng(1), 3)
    mean, cov, w = covariance_intersection([[1.0, 2.0, 3.0], [3.0, 2.0, 1.0]], [P, P])
    np.testing.assert_allclose(cov, P, rtol=1e-10)
    np.testing.assert_allclose(mean, 2.0)
    assert w == 0.5


def test_the_covariance_is_a_bound_for_every_correlation():
    """The errors' cross-covariance is L1 Ω L2ᵀ with any Ω of norm 1 or less; added information breaks the bound."""
    rng = np.random.default_rng(4)
    for _ in range(10):
        covs = np.stack([covariance(rng, 3), covariance(rng, 3)])
        _, P, _ = covariance_intersection(np.zeros((2, 3)), covs)
        K1, K2 = gains(covs)
        naive = np.linalg.inv(np.linalg.inv(covs).sum(axis=0))
        N1, N2 = naive @ np.linalg.inv(covs)
        L1, L2 = np.linalg.cholesky(covs)
        broken = 0
        for _ in range(50):
            Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
            cross = L1 @ (rng.uniform(0.0, 1.0) * Q) @ L2.T

            def actual(A, B, cross=cross, covs=covs):
                return A @ covs[0] @ A.T + B @ covs[1] @ B.T + A @ cross @ B.T + B @ cross.T @ A.T

            assert np.linalg.eigvalsh(P - actual(K1, K2))[0] > -1e-9 * np.trace(P)
            broken += np.linalg.eigvalsh(naive - actual(N1, N2))[0] < -1e-9 * np.trace(naive)
        assert broken > 25


def test_errors_of_two_filters_with_shared_noise():
    """Monte Carlo: two estimates whose errors have a part in common; their mean NEES is at most 1."""
    rng = np.random.default_rng(5)
    trials, n = 4000, 2
    covs = np.stack([np.diag([1.0, 4.0]), np.array([[3.0, 0.5], [0.5, 1.0]])])
    common = 0.5 * np.diag([1.0, 1.0])  # of both
    shared = rng.multivariate_normal(np.zeros(n), common, trials)
    errors = np.stack([shared + rng.multivariate_normal(np.zeros(n), P - common, trials) for P in covs])
    K1, K2 = gains(covs)
    _, P, _ = covariance_intersection(np.zeros((2, n)), covs)
    naive = np.linalg.inv(np.linalg.inv(covs).sum(axis=0))
    N1, N2 = naive @ np.linalg.inv(covs)

    def nees(A, B, cov):
        error = errors[0] @ A.T + errors[1] @ B.T
        return np.mean(np.einsum("ti,ij,tj->t", error, np.linalg.inv(cov), error)) / n

    margin = 4.0 / np.sqrt(n * trials)  # four deviations of a mean of chi-squares are 4 √(2 / n trials)
    assert nees(K1, K2, P) < 1.0 + margin * np.sqrt(2.0)
    assert nees(N1, N2, naive) > 1.2


@cases(__file__, "unfusible.csv")
def test_estimates_that_cannot_be_fused_are_refused(means, covs, text):
    assert text in error_of(EstimatorError, covariance_intersection, json.loads(means), json.loads(covs))


def message(twin, mean, cov, **fields):
    """A state message by names."""
    values = list(mean.items())
    P = np.atleast_2d(cov)
    states = [
        {"name": n, "unit": "°C", "value": v, "std": float(np.sqrt(P[k, k])), "valid": True, "reason": ""}
        for k, (n, v) in enumerate(values)
    ]
    return {
        "version": "nisus.state/1", "twin": twin, "time_ns": 10**9, "states": states, "covariance": P.tolist(),
        "covariance_of": list(mean), **fields,
    }  # fmt: skip


EDGE = message("edge", {"tooth": 41.0, "winding": 60.0}, [[0.04, 0.01], [0.01, 0.09]])
HEAVY = message("heavy", {"winding": 60.5, "magnet": 70.0, "tooth": 41.2}, np.diag([0.04, 9.0, 0.02]))


def test_messages_are_fused_in_the_states_that_they_share():
    fused = fuse(EDGE, HEAVY)
    mean, cov, w = covariance_intersection(
        [[41.0, 60.0], [41.2, 60.5]], [[[0.04, 0.01], [0.01, 0.09]], np.diag([0.02, 0.04])]
    )
    assert (fused.states, fused.units, fused.time_ns, fused.weight) == (("tooth", "winding"), ("°C", "°C"), 10**9, w)
    np.testing.assert_array_equal(fused.mean, mean)
    np.testing.assert_array_equal(fused.cov, cov)
    np.testing.assert_allclose(fused.difference, [-0.2, -0.5])
    np.testing.assert_allclose(fused.bound, [2.0 * (0.2 + np.sqrt(0.02)), 2.0 * (0.3 + 0.2)])
    assert fused.agrees
    hot = message("heavy", {"winding": 61.1, "tooth": 41.0}, np.diag([0.04, 0.02]))
    assert not fuse(EDGE, hot).agrees


def test_one_state_of_another_name_needs_no_covariance():
    rate = message("winding", {"temperature": 59.0}, [[0.25]], covariance=None, covariance_of=None)
    fused = fuse(rate, HEAVY, same={"temperature": "winding"})
    assert fused.states == ("temperature",) and fused.weight == 0.0
    np.testing.assert_allclose([fused.mean[0], fused.std[0]], [60.5, 0.2])


def test_angles_are_fused_across_the_turn():
    a, b = (message(n, {"heading": v}, [[0.01]]) for n, v in (("a", np.pi - 0.1), ("b", -np.pi + 0.3)))
    fused = fuse(a, b, circular=["heading"])
    np.testing.assert_allclose([fused.mean[0], fused.difference[0]], [-np.pi + 0.1, -0.4])


@cases(__file__, "unfusible_messages.csv")
def test_messages_that_cannot_be_fused_are_refused(changes, options, text):
    other = HEAVY | json.loads(changes)
    assert text in error_of(EstimatorError, fuse, EDGE, other, **json.loads(options))


def test_times_may_differ_by_what_is_allowed():
    assert fuse(EDGE, {**HEAVY, "time_ns": 1_040_000_000}, within=0.05).time_ns == 1_040_000_000
