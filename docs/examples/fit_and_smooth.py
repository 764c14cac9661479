"""Fit Q and R to a recorded log, then smooth it: three minutes of a traction motor's CAN bus.

The rotor magnet has no sensor, so smoothing, which uses later measurements too, helps it most.

Run: python docs/examples/fit_and_smooth.py
"""

import numpy as np

from nisus import fold
from nisus.app.twin.log_reader import read_log
from nisus.app.twin.twin import load_twin
from nisus.estimators.smoothing.em import em


def fit_and_smooth(name="motor_can"):
    """Return the log, the tuning fitted by expectation maximisation, and the filtered and smoothed estimates."""
    twin = load_twin(name)
    log, _ = read_log(twin, None)  # the recording that the twin's YAML names
    fitted = em("ekf", twin.model, twin.tuning, log)
    tuned = {"tuning": fitted.tuning, "covariance": True}
    return log, fitted, fold("ekf", twin.model, log, **tuned), fold("ekf", twin.model, log, smoothed=True, **tuned)


if __name__ == "__main__":
    log, fitted, filtered, smoothed = fit_and_smooth()
    model = filtered.model
    print(f"log-likelihood {fitted.log_likelihood[0]:.1f} -> {fitted.log_likelihood[-1]:.1f}")
    for row, variance in zip(model.row_names, fitted.tuning.r, strict=True):
        print(f"R.{row:<8} {np.sqrt(variance):.3f} °C")
    print("state      RMSE filtered   smoothed   (°C)")
    before, after = filtered.score().states, smoothed.score().states
    for state in model.state_names:
        print(f"{state:<10} {before[state].rmse:13.3f} {after[state].rmse:10.3f}")
