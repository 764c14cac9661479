"""Recordings of the eight assets, drawn by NumPy from their equations, in none of the program's ways."""

from pathlib import Path

import numpy as np

from tests.app.study.advice.assets import CELLS, EVERY

YAML = """\
model: {model}
estimator: {estimator}
source:
  type: table
  files: {files}
  time: {{column: t}}
  sensors: {{{sensors}}}
  inputs: {{{inputs}}}
"""

N = 600
"""Readings, one a second."""


def cart(rng: np.random.Generator, n: int = N) -> np.ndarray:
    """Places of a cart whose speed is a random walk."""
    place, speed, places = 0.0, 0.0, []
    for _ in range(n):
        place, speed = place + speed + rng.normal(0, 0.001**0.5), speed + rng.normal(0, 0.1)
        places.append(place)
    return np.array(places)


def linear(rng):
    return {"rail": cart(rng) + rng.normal(0, 1, N)}, {}


def tails(rng):
    """One reading in fifteen is an outlier of ten times the noise."""
    wild = np.where(rng.random(N) < 1 / 15, 10.0, 1.0)
    return {"rail": cart(rng) + wild * rng.normal(0, 1, N)}, {}


STUCK = slice(200, 260)
"""Readings of the rail that repeat the first of them."""


def stuck(rng):
    """As `linear`, twice as long, with a sensor that is stuck for a minute while the cart, so far moving on, rests."""
    steps = np.diff(cart(rng, 2 * N), prepend=0.0)
    steps[: STUCK.start] += 2.0
    steps[STUCK] = 0.0
    values = np.cumsum(steps) + rng.normal(0, 1, 2 * N)
    values[STUCK] = values[STUCK.start]
    return {"rail": values}, {}


def mild(rng):
    inflow = 0.1 + 0.02 * np.sin(np.arange(N) / 40)
    level, levels = 1.0, []
    for u in inflow:
        level += u - 0.1 * np.sqrt(max(level, 0.01)) + rng.normal(0, 1e-5**0.5)
        levels.append(level)
    return {"gauge": np.array(levels) + rng.normal(0, 0.01, N)}, {"inflow": inflow}


def strong(rng):
    x, xs = 0.0, []
    for _ in range(N):
        x = np.exp(-1 / 5) * x + rng.normal(0, 0.4**0.5)
        xs.append(x)
    return {"glow": np.exp(xs) + rng.normal(0, 0.5, N)}, {}


ERROR, LASTS, WHITE = 0.8, 15.0, 0.3
"""Of the float: deviation of the error that lasts, m, how long it lasts, s, and deviation of its white noise, m."""


def erring(rng):
    """A level that hardly changes, read with an error that is e⁻¹ of itself after `LASTS` seconds."""
    error, errors, a = 0.0, [], np.exp(-1.0 / LASTS)
    for _ in range(4 * N):
        error = a * error + rng.normal(0, ERROR * np.sqrt(1.0 - a * a))
        errors.append(error)
    return {"float": 2.0 + np.array(errors) + rng.normal(0, WHITE, 4 * N)}, {}


def peaks(rng):
    x = 5.0 + np.cumsum(rng.normal(0, 0.1, N))
    x = np.sign(x) * np.maximum(np.abs(x), 2.0)
    return {"distance": x**2 + rng.normal(0, 2, N)}, {}


def field(rng):
    warmth, rows = rng.normal(0, 1, CELLS), []
    for _ in range(120):
        before = np.roll(warmth, 1)
        warmth = warmth + 0.4 * (before - warmth) + 0.1 * (before - 2 * warmth + np.roll(warmth, -1))
        z = rng.normal(0, 1, CELLS)
        kernel = sum(np.roll(z, -k) for k in range(10)) / np.sqrt(10)
        warmth += np.sqrt(0.05) * kernel
        rows.append(warmth[::EVERY] + rng.normal(0, 0.2, CELLS // EVERY))
    return {f"p{k}": column for k, column in zip(range(0, CELLS, EVERY), np.array(rows).T, strict=True)}, {}


def varying(rng):
    flow = 0.05 + 0.4 * (np.arange(N) // 50 % 2)
    x, xs = 10.0, []
    for u in flow:
        x = np.exp(-u) * x + rng.normal(0, 0.5**0.5)
        xs.append(x)
    return {"probe": np.array(xs) + rng.normal(0, 0.5, N)}, {"flow": flow}


def write(folder: Path, name: str, model: str, estimator: str, make, sensor: str, seed: int = 1) -> Path:
    """A CSV and the YAML that reads it."""
    readings, inputs = make(np.random.default_rng(seed))
    columns = {**readings, **inputs}
    # Inputs hold from their time on: those of a step stand at its beginning.
    n = len(next(iter(readings.values())))
    table = np.column_stack([np.arange(n, dtype=float), *columns.values()])
    path = folder / f"{name}.csv"
    np.savetxt(path, table, delimiter=",", header=",".join(["t", *columns]), comments="", fmt="%.9g")
    names = ", ".join(readings)
    text = YAML.format(
        model=f"{Path(__file__).with_name('assets.py')}:{model}",
        estimator=estimator,
        files=path.name,
        sensors=f"{sensor}: {{columns: [{names}]}}",
        inputs=", ".join(f"{key}: {{columns: {key}}}" for key in inputs),
    )
    (folder / f"{name}.yaml").write_text(text)
    return folder / f"{name}.yaml"
