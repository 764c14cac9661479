"""What it costs to smooth a fold, beside the fold itself and beside FilterPy's and statsmodels' smoothers."""

from __future__ import annotations

import numpy as np

from estimators.fold import Fold
from estimators.log import READING, Events, Log
from estimators.smoothing.smooth import smooth
from estimators.tuning import Tuning

from ..estimators.smoothing.test_textbook import CAR
from ..support import SECOND
from .timing import judged, medians

STEPS, SHORT, BOUND = 100_000, 10_000, 0.3
FILTERS = ("kf", "ekf", "iekf", "ukf", "ckf", "sr-kf", "sr-ekf", "sr-ukf")
F = np.kron(np.array([[1.0, 0.1], [0.0, 1.0]]), np.eye(2))
Q = np.kron(np.array([[0.1**3 / 3, 0.1**2 / 2], [0.1**2 / 2, 0.1]]), np.eye(2))
H, R = np.eye(2, 4), 0.25 * np.eye(2)


def smoothing() -> None:
    """10^5 readings of a car, four states: the fold, and its smoother."""
    ys = np.cumsum(np.random.default_rng(0).normal(0, 0.1, (STEPS, 2)), axis=0)
    print(f"smoothing: {STEPS:,} readings of 2 rows, 4 states; seconds of the processor")
    print(f"{'filter':8}{'fold':>10}{'smooth':>10}")
    t = np.arange(STEPS) * (SECOND // 10)
    log = Log.of(CAR)
    log.extend(Events(t, t, np.full(STEPS, READING, np.int8), np.zeros(STEPS, np.int32), ys))
    for name in FILTERS:
        fold = Fold(name, CAR, Tuning.of(CAR), log)

        def again(fold: Fold = fold) -> None:
            fold.rewind(0)
            fold.advance()

        def back(fold: Fold = fold) -> None:
            smooth(fold)

        folded, smoothed = medians([again, back], 5)
        print(f"{name:8}{folded:10.3f}{smoothed:10.3f}  {judged(smoothed, BOUND, at_least=False)} of {BOUND} s")
    theirs = medians([lambda: filterpy_rts(ys[:SHORT]), lambda: statsmodels_smoother(ys[:SHORT])], 3)
    for name, seconds in zip(("FilterPy, kf and rts_smoother", "statsmodels, KalmanSmoother"), theirs, strict=True):
        print(f"{name}: {seconds * STEPS / SHORT:.2f} s, from {SHORT:,} readings")


def filterpy_rts(ys: np.ndarray) -> None:
    """Filter and smooth."""
    from filterpy.kalman import KalmanFilter

    its = KalmanFilter(4, 2)
    its.x, its.P, its.F, its.Q, its.H, its.R = np.zeros((4, 1)), np.eye(4), F, Q, H, R
    means, covs, _, _ = its.batch_filter(ys[:, :, None])
    its.rts_smoother(means, covs)


def statsmodels_smoother(ys: np.ndarray) -> None:
    """Filter and smooth."""
    from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother

    its = KalmanSmoother(2, 4, design=H, transition=F, selection=np.eye(4), obs_cov=R, state_cov=Q)
    its.bind(ys)
    its.initialize_known(np.zeros(4), np.eye(4))
    its.smooth()
