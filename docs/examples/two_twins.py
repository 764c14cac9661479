"""Two twins of one motor, a small one on every measurement and a thermal model on every tenth, compared and fused.

The edge twin takes the three measured temperatures for random walks, so it needs no currents and three states. The
other twin has a thermal model, and estimates the rotor magnet too. Both use the same thermocouples, so their errors are
correlated, and to add their information would be overconfident.

Run: python docs/examples/two_twins.py
"""

import numpy as np

from nisus import Log, Noise, StateSpaceModel, covariance_intersection, fold
from nisus.app.twin.log_reader import read_log
from nisus.app.twin.twin import load_twin
from nisus.estimators.log import READING, TRUTH, Events

SHARED = ["winding", "tooth", "yoke"]


def hold(x, u, p, dt, out):
    """Temperatures stay as they are; the noise carries their change."""
    out[0], out[1], out[2] = x[0], x[1], x[2]


def two_twins(every=10):
    """Return errors (T, 3) and covariances (T, 3, 3) of the shared states, °C, by estimate, at every tenth message."""
    twin = load_twin("motor_can")
    bus, _ = read_log(twin, None)
    small = StateSpaceModel(
        name="edge",
        title="Measured temperatures of a motor",
        states=twin.model.states[:3],
        inputs=twin.model.inputs,  # on the bus, unused
        sensors=twin.model.sensors,
        noises=tuple(Noise(name, "°C²/s", v) for name, v in zip(SHARED, (0.1, 0.03, 0.01), strict=True)),
        f=hold,
        linear=True,
    )
    events = bus.events
    measured, known = events.kind == READING, events.kind == TRUTH
    times = np.unique(events.t[measured])[::every]
    everything = log_of(small, events, ~known)  # there is no magnet whose truth the edge twin could be given
    decimated = log_of(twin.model, events, ~measured | np.isin(events.t, times))

    edge = fold("kf", small, everything, R=dict.fromkeys(SHARED, 0.25), covariance=True)
    thermal = fold("ukf", twin.model, decimated, tuning=twin.tuning, covariance=True)
    means, covs = np.empty((2, times.size, 3)), np.empty((2, times.size, 3, 3))
    for k, run in enumerate((edge, thermal)):
        rows = run.readings("yoke")  # the last of the three in a message
        rows = rows[np.isin(run.events.t[rows], times)]
        means[k], covs[k] = run.mean[rows, :3], run.cov[rows, :3, :3]

    fused = [covariance_intersection(means[:, k], covs[:, k]) for k in range(times.size)]
    information = np.linalg.inv(covs)
    added = np.linalg.inv(information.sum(axis=0))
    added_mean = np.einsum("tij,ktjl,ktl->ti", added, information, means)

    truth = np.stack([np.interp(times, events.t[known], events.value[known, k]) for k in range(3)], axis=1)
    return {
        "edge": (means[0] - truth, covs[0]),
        "thermal": (means[1] - truth, covs[1]),
        "added": (added_mean - truth, added),
        "fused": (np.array([mean for mean, _, _ in fused]) - truth, np.array([cov for _, cov, _ in fused])),
    }


def log_of(model, events, kept):
    """Return a log of a model with a part of the events."""
    log = Log.of(model)
    log.extend(Events(*(column[kept] for column in events)))
    return log


if __name__ == "__main__":
    print("estimate   RMSE (°C)   2 σ (°C)   in the 95 % band: " + ", ".join(SHARED))
    for name, (error, cov) in two_twins().items():
        band = 2.0 * np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
        inside = ", ".join(f"{100.0 * share:.0f} %" for share in np.mean(np.abs(error) <= band, axis=0))
        print(f"{name:<10} {np.sqrt(np.mean(error**2)):9.3f} {np.mean(band):10.2f}   {inside}")
