"""The square-root Kalman filter: exact for a linear model, on a factor of P, by Householder triangularisation."""

from __future__ import annotations

from dataclasses import replace

from ..compiled.context import transition
from ..estimator import CONSTANT, FACTOR, Options, SmoothingRule
from ..numerics.jit import by_address
from ..numerics.workspace import size_of, start_of
from . import sr_ekf
from .kf import KF, constant_jacobian, kept, kept_in
from .robust import OPTIONS
from .shared import moments_of
from .square_root import describe, moments, start
from .sr_ekf import advance, predicting


def work_size(options: Options, nx: int, ny: int) -> int:
    """Return the scratch: the square-root EKF's, and the numbers kept from step to step."""
    return sr_ekf.work_size(options, nx, ny) + size_of(kept, nx)


@by_address
def predict(context, u, dt, index, state, work):
    """x ← F x + B u;  Uᵀ U ← F Uᵀ U Fᵀ + Q.

    Source: Kailath, Sayed & Hassibi, Linear Estimation (2000), chapter 12.
    """
    n = context.nx
    x, _ = moments_of(state, n)
    own = predicting(start_of(work), n)
    constant = kept_in(work, n)
    constant_jacobian(context, u, dt, constant, own.jacobian)
    transition(context, x, u, dt, own.forward)
    advance(context, u, dt, state, own, constant.F)


SR_KF = replace(
    KF,
    name="sr-kf",
    title="Square-root Kalman filter",
    assumes="linear f and h, Gaussian noise; then exact, at any conditioning",
    source="Kailath, Sayed & Hassibi (2000), Linear Estimation, chapter 12",
    functions=(start, predict, sr_ekf.update, describe),
    work_size=work_size,
    moments=moments,
    smoothing=SmoothingRule(CONSTANT, FACTOR),
    options=OPTIONS,
)
