"""FilterPy's classes as the adapter in filterpy.py uses them, two with a method of their own."""

from __future__ import annotations

from types import FunctionType, MethodType

import numpy as np
from filterpy.kalman import (
    EnsembleKalmanFilter,
    ExtendedKalmanFilter,
    KalmanFilter,
    MerweScaledSigmaPoints,
    UnscentedKalmanFilter,
)

__all__ = ["Ensemble", "Extended", "KalmanFilter", "MerweScaledSigmaPoints", "UnscentedKalmanFilter"]


class Extended(ExtendedKalmanFilter):
    """FilterPy's EKF whose mean goes through f itself."""

    forward: np.ndarray

    def predict_x(self, u: object = 0) -> None:
        """x ← what f made of it."""
        self.x = self.forward


class Ensemble(EnsembleKalmanFilter):
    """FilterPy's EnKF with draws of its own generator."""

    def __init__(self, nx: int, members: int) -> None:
        self.rng = np.random.default_rng(0)

        def draw(mean: np.ndarray, cov: np.ndarray, size: int) -> np.ndarray:
            return self.rng.multivariate_normal(mean, cov, size, check_valid="ignore")

        for name in ("initialize", "predict", "update"):
            method = getattr(EnsembleKalmanFilter, name)
            own = {**method.__globals__, "multivariate_normal": draw}
            function = FunctionType(method.__code__, own, name, method.__defaults__, method.__closure__)
            setattr(self, name, MethodType(function, self))
        super().__init__(x=np.zeros(nx), P=np.zeros((nx, nx)), dim_z=1, dt=0.0, N=members, hx=None, fx=None)

    def seed(self, *place: int) -> None:
        """Draw from here on what (seed, draw, stream) determine."""
        self.rng = np.random.default_rng([number % 2**64 for number in place])
