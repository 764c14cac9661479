"""What an episode says: one sentence with who, how much, since when, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..compiled.model import compile_model
from ..model.indicator import indicator
from ..model.state_space import Input, State, StateSpaceModel
from ..tuning import Tuning

CORRELATED = 0.15
"""Lag-1 correlation of the innovations from which Q is to blame for their scale, not R."""

EPOCH = 1e8
"""Seconds from which on a time is one of the calendar (it is after 1973), not one since a recording's start."""


def since(seconds: float) -> str:
    """From when on, as a clock shows it, or in seconds of the log."""
    if seconds < EPOCH:
        return f"since {seconds:.1f} s"
    of_day = int(seconds) % 86400
    return f"since {of_day // 3600:02}:{of_day // 60 % 60:02}:{of_day % 60:02} UTC"


def seen_by(model: StateSpaceModel) -> np.ndarray:
    """Which states each sensor's reading depends on at the prior, (sensors, nx) of bool."""
    compiled = compile_model(indicator(model))
    x0, u = model.prior_mean.copy(), np.array([item.default for item in model.inputs], float)
    p = np.array([item.value for item in model.parameters], float)
    seen = np.zeros((len(model.sensors), model.nx), bool)
    for s, sensor in enumerate(model.sensors):
        y, moved = np.empty(len(sensor.rows)), np.empty(len(sensor.rows))
        compiled.h[s](x0, u, p, y)
        for j in range(model.nx):
            x = x0.copy()
            x[j] += 0.1 * model.prior_std[j] or 1e-3
            compiled.h[s](x, u, p, moved)
            seen[s, j] = bool(np.any(moved != y))
    return seen


def only_seen_by(model: StateSpaceModel, s: int) -> list[str]:
    """The states that no other sensor's reading depends on."""
    if model.nx > 64 or model.black_box:
        return []
    seen = seen_by(model)
    others = np.delete(seen, s, axis=0).any(axis=0)
    return [model.state_names[int(j)] for j in np.flatnonzero(seen[s] & ~others)]


def noises_behind(model: StateSpaceModel, s: int) -> str:
    """Q of the noises that act on the states that a sensor sees, as keys of a tuning."""
    if model.nx > 64 or model.black_box:
        return "Q"
    seen = np.flatnonzero(seen_by(model)[s])
    names = [noise.name for noise in model.noises if set(model.acts_on(noise.name)) & set(seen.tolist())]
    return " or ".join(f"Q.{name}" for name in names[:3]) or "Q"


def of_sensor(
    model: StateSpaceModel,
    tuning: Tuning,
    s: int,
    k: int,
    cause: str,
    size: float,
    about: float,
    correlation: float,
    start: float,
    reasons: str = "",
) -> str:
    """An episode of row k of sensor s.

    Args:
        model: The model.
        tuning: That ran.
        s: The sensor.
        k: Its row.
        cause: What is wrong.
        size: By how much, see effects.py.
        about: Mean of the innovations, in the row's unit.
        correlation: Their lag-1 correlation.
        start: When it began, s.
        reasons: Limits that the readings break, of one that is screened.
    """
    sensor = model.sensors[s]
    row = sensor.rows[k]
    name, unit = model.row_names[model.row_start[s] + k], _spaced(row.unit)
    when = since(start)
    if cause == "shifted":
        side = "above" if about > 0 else "below"
        size_in_words = f"{abs(about):.3g}{unit} ({abs(size):.1f} σ)"
        where = f"{name} reads {size_in_words} {side} the prediction {when}"
        return f"{where}: the sensor, an input or a parameter; hold {sensor.name} out to see"
    if cause == "narrow":
        why = f"{noises_behind(model, s)} too small" if correlation > CORRELATED else f"R.{name} too small"
        return (
            f"bands of {name} are too narrow {when}: off {size:.2f} times as far as predicted; {why}, or it got noisier"
        )
    if cause == "wide":
        why = f"{noises_behind(model, s)} too large" if correlation < -CORRELATED else f"R.{name} too large"
        return f"bands of {name} are too wide {when}: off {size:.2f} times as far as predicted; {why}"
    if cause == "correlated":
        why = f"{noises_behind(model, s)} too small, or a missing state"
        return f"innovations of {name} are correlated ({size:+.2f}) {when}: {why}"
    if cause == "alternating":
        why = f"{noises_behind(model, s)} too large, so that the estimate follows the noise"
        return f"innovations of {name} change sign ({size:+.2f}) {when}: {why}"
    if cause == "spiky":
        return f"{name} spikes {when}: {100 * size:.2g} % of its readings are outliers; set a gate, look at its wiring"
    if cause == "refused":
        what = f"{name} is refused by the gate {when} ({100 * size:.0f} % of its readings)"
        if len(model.sensors) == 1:
            return f"{what}: the sensor is wrong, or the twin is; look at the sensor, and Reset where that is right"
        return f"{what}: the sensor is wrong, or the twin is; hold {sensor.name} out to see whether the others agree"
    if cause == "screened":
        what = f"{name} breaks its limits ({reasons}) {when}: {100 * size:.0f} % of its readings are not used"
        return f"{what}; {_lost(model, s)}; look at the sensor, or at sensors.{sensor.name} in the YAML"
    if cause == "stuck":
        return f"{name} is stuck at {size:.6g}{unit} {when}: {_lost(model, s)}; hold it out until it is mended"
    if cause == "disagreeing":
        return f"rows of {sensor.name} contradict each other {when}: R.{sensor.name} too small, or one of them is wrong"
    return f"rows of {sensor.name} are closer to the prediction than their noise {when}: R.{sensor.name} too large"


def _lost(model: StateSpaceModel, s: int) -> str:
    only = only_seen_by(model, s)
    if not only:
        return "other sensors see the same states"
    return f"{' and '.join(only[:4])} {'is' if len(only) == 1 else 'are'} measured by nothing else"


def of_silence(model: StateSpaceModel, s: int, cause: str, start: float, lasted: float | None) -> str:
    """A sensor that says nothing since `start`, or said nothing for `lasted` seconds."""
    name = model.sensors[s].name
    if lasted is not None:
        what = f"was silent for {lasted:.3g} s {since(start)}"
        if cause == "never heard":
            what = f"was heard for the first time after {lasted:.3g} s"
        return f"{name} {what}: {_lost(model, s)}; look at its wiring and its bus if that is too long"
    if cause == "never heard":
        return f"{name} was never heard: {_lost(model, s)}; check its channel map and its bus"
    return f"{name} is silent {since(start)}: {_lost(model, s)}; check its wiring and its bus"


def of_return(cause: str, start: float) -> str:
    """What is added of a sensor that is in order again while its alarm has not fallen, or may come back."""
    if cause == "stuck":
        return f"it moves again {since(start)}"
    return f"back to normal {since(start)}: the alarm goes with more such readings"


def of_stale(start: float) -> str:
    """A twin that no reading reaches."""
    return f"no reading was used {since(start)}: the estimate is the model's alone; check the source"


def of_loss(start: float, off: Sequence[str], sensors: int) -> str:
    """A twin of so many sensors whose estimate is lost; `off`: those refused, shifted, stuck or screened now.

    While a fault lasts, a reset starts from wrong readings, and with the prior's wide bands believes them.
    """
    lost = f"the estimate is lost {since(start)}"
    if not off:
        return f"{lost}: Reset starts again from the prior; then look at which sensor spoke first"
    if sensors == 1:
        return f"{lost}, and {off[0]} contradicts it still: look at the sensor, and Reset where that is right"
    many = len(off) > 1
    names = ", ".join(off[:4]) + (", ..." if len(off) > 4 else "")
    one = "contradicts it still: hold it out first,"
    says = "contradict it still: hold them out first, one by one," if many else one
    return f"{lost}, and {names} {says} and Reset when the rest agrees"


def _spaced(unit: str) -> str:
    """A unit as it follows a number; of what has none, nothing."""
    return f" {unit}" if unit and unit != "1" else ""


def of_truth(name: str, rmse: float, unit: str, size: float, start: float) -> str:
    """A state whose truth was told, and is `rmse` away, `size` standard deviations."""
    where = f"{name} is {rmse:.3g}{_spaced(unit)} ({size:.1f} σ) from the truth {since(start)}"
    return f"{where}: the estimate is wrong and its band does not say so; look at what else is in alarm"


def of_particles(effective: float, ancestors: float, start: float) -> str:
    """A cloud of which a few particles carry the estimate."""
    many = "one particle" if ancestors < 2.0 else f"{ancestors:.0f} particles"
    what = f"the cloud is impoverished {since(start)}: {effective:.3g} particles count, and all descend from {many}"
    return f"{what}; more particles, pf-ekf or pf-reg, or a larger Q of the states that hardly move"


def of_range(item: State | Input, size: float, start: float) -> str:
    """A state or an input that is outside the range in which the model was fitted."""
    assert item.fitted is not None
    low, high = item.fitted
    return (
        f"{item.name} is {size:.4g}{_spaced(item.unit)}, outside {low:g} to {high:g} where the model was fitted, "
        f"{since(start)}: bands hold only inside; use a model fitted there"
    )
