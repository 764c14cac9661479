"""The iterated extended Kalman filter: the update is linearised again at its own result until that converges.

Each iteration is a Gauss-Newton step to the minimum of ½ |x - x̂|²_P⁻¹ + ½ |y - h(x)|²_R⁻¹. The update is that of ekf.py
with at most `iterations`, which may be too few.

Source: Bell & Cathey (1993), doi:10.1109/9.250476.
"""

from __future__ import annotations

from dataclasses import replace

from ..estimator import Option
from .ekf import EKF

IEKF = replace(
    EKF,
    name="iekf",
    title="Iterated extended Kalman filter",
    assumes="differentiable f and h; h may curve within the spread, if the posterior has one peak",
    model_runs="1, and h once an iteration; each and its derivatives (nx by complex step)",
    fails_when="Gauss-Newton overshoots or two peaks fit; f's curvature makes it overconfident like the EKF",
    source="Bell & Cathey (1993), doi:10.1109/9.250476",
    options=(Option("iterations", 3, 1, 100, "", "most linearisations per measurement; 1 is the EKF"), *EKF.options),
)
