"""Models that tests of several packages share: a level read by any number of sensors, a plant of many channels."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel


def unchanged(x, u, p, dt, out):
    out[:] = x


def first_state(x, u, p, out):
    out[:] = x[0]


def second_state(x, u, p, out):
    out[0] = x[1]


def first_states(x, u, p, out):
    out[:] = x[: out.size]


def constant_speed(x, u, p, dt, out):
    out[0] = x[0] + dt * x[1]
    out[1] = x[1]


def first_state_squared(x, u, p, out):
    out[0] = x[0] * x[0]


def complex_step(function: Callable[[Any, Any], object], x: np.ndarray, rows: int) -> np.ndarray:
    """Derivatives (rows, n) of function(x, out) at x, exact but for rounding."""
    slope = np.empty((rows, x.size))
    for j in range(x.size):
        z, out = x.astype(complex), np.empty(rows, complex)
        z[j] += 1e-20j
        function(z, out)
        slope[:, j] = out.imag / 1e-20
    return slope


def level_model(
    sensors: Mapping[str, float | Mapping[str, float]],
    q: float,
    *,
    state: str = "level",
    mean: float = 0.0,
    std: float = 1.0,
    h: Any = first_state,
    **fields: Any,
) -> StateSpaceModel:
    """Return a random walk of one state; all rows of all sensors read it.

    Args:
        sensors: Variance by sensor, or by row of a sensor with several.
        q: Variance that a second adds.
        state: Name of the state.
        mean: Prior mean, m.
        std: Prior standard deviation, m.
        h: Function of every sensor.
        fields: Other fields of the model, which replace these.
    """
    rows = {name: given if isinstance(given, Mapping) else {name: given} for name, given in sensors.items()}
    given: dict[str, Any] = {
        "name": state,
        "title": state,
        "states": (State(state, "m", mean, std),),
        "noises": (Noise(state, "m²/s", q),),
        "sensors": tuple(
            Sensor(name, tuple(Row(row, "m", variance) for row, variance in own.items()), h=h)
            for name, own in rows.items()
        ),
        "f": unchanged,
    }
    return StateSpaceModel(**(given | fields))


def many_states(count: int) -> StateSpaceModel:
    """Return a model of this many states, of which the first is read."""
    return level_model(
        {"y": 1.0}, 1.0, state="x0", name="many", states=tuple(State(f"x{k}", "m") for k in range(count))
    )


FLOAT_AND_SONAR = level_model({"float": 1.0, "sonar": {"near": 1.0, "far": 1.0}}, 0.1)
"""A level read by a sensor with one row and one with two."""


PLANT = """\
from estimators.model import Noise, Row, Sensor, State, StateSpaceModel

ZONES = {zones}
CHANNELS = {channels}

def exchange(x, u, p, dt, out):
    for k in range(ZONES):
        out[k] = x[k] + 0.01 * dt * (x[max(k - 1, 0)] - 2.0 * x[k] + x[min(k + 1, ZONES - 1)])

def thermometer(zone, gain, offset):
    def h(x, u, p, out):
        out[0] = gain * x[zone] + offset
    return h

def placed_thermometer(x, u, p, place, out):
    out[0] = place[1] * x[int(place[0])] + place[2]

def plant(sensors):
    return StateSpaceModel(
        name="plant", title="Zones that exchange heat", f=exchange, linear=True, sensors=sensors,
        states=tuple(State(f"zone_{{k}}", "degC", mean=50.0, std=5.0) for k in range(ZONES)),
        noises=tuple(Noise(f"zone_{{k}}", "degC²/s", 0.01) for k in range(ZONES)),
    )

ROWS = (Row("temperature", "degC", 0.25),)
Each = plant(tuple(Sensor(f"TT{{k:04d}}", ROWS, h=thermometer(*channel)) for k, channel in enumerate(CHANNELS)))
Family = plant((Sensor("TT", ROWS, h=placed_thermometer, place=(("zone", "1"), ("gain", "1"), ("offset", "degC"))),))
"""


def write_plant(folder: Path, count: int, *, family: bool, seconds: int = 20, biased: int | None = None) -> Path:
    """Write a twin of 40 zones with a column for each of `count` thermometers; return its YAML.

    Args:
        folder: Where to write the YAML, the model and the table.
        count: Thermometers, each with a gain and an offset.
        family: Whether they are landmarks of one sensor, declared at once, or a sensor each.
        seconds: Length of the table, a row each second.
        biased: Thermometer that reads 5 °C too much in the second half.
    """
    zones = 40
    rng = np.random.default_rng(0)
    zone, gain, offset = np.arange(count) * zones // count, rng.uniform(0.9, 1.1, count), rng.normal(0.0, 1.0, count)
    channels = [(int(z), float(g), float(o)) for z, g, o in zip(zone, gain, offset, strict=True)]
    temperature = rng.normal(50.0, 5.0, (seconds, zones))
    for before, now in zip(temperature, temperature[1:], strict=False):
        wide = np.pad(before, 1, mode="edge")
        now[:] = before + 0.01 * (wide[:-2] - 2.0 * before + wide[2:]) + rng.normal(0.0, 0.1, zones)
    values = gain * temperature[:, zone] + offset + rng.normal(0.0, 0.5, (seconds, count))
    if biased is not None:
        values[seconds // 2 :, biased] += 5.0
    names = [f"{k:04d}" for k in range(count)]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "plant.py").write_text(PLANT.format(zones=zones, channels=channels))
    table = [f"{t}," + ",".join(f"{value:.3f}" for value in row) for t, row in enumerate(values)]
    (folder / "plant.csv").write_text("\n".join(["t," + ",".join(f"TT{name}" for name in names), *table]) + "\n")
    lines = [f"model: ./plant.py:{'Family' if family else 'Each'}", "estimator: kf", "gate: 0.9999", "sensors:"]
    if family:
        lines += ["  TT:", "    std: 0.5", "    landmarks:"]
        lines += [f"      {name}: [{z}, {g}, {o}]" for name, (z, g, o) in zip(names, channels, strict=True)]
    else:
        lines += [f"  TT{name}: {{std: 0.5}}" for name in names]
    lines += ["source:", "  type: table", "  files: plant.csv", "  time: {column: t, unit: s}", "  sensors:"]
    lines += ["    TT: {columns: TT*}"] if family else [f"    TT{name}: {{columns: TT{name}}}" for name in names]
    path = folder / "plant.yaml"
    path.write_text("\n".join(lines) + "\n")
    return path
