"""Sensors of equal code share it: their numbers are those of plain Python and of code of their own."""

import numpy as np
import pytest

from estimators import Log, fold
from estimators.compiled import model_code
from estimators.compiled.model import _compile, compile_model
from estimators.model import Noise, Parameter, Row, Sensor, State, StateSpaceModel
from estimators.model.assemble import JointParameter, assemble
from estimators.model.coloured import ColouredError
from estimators.model.landmarks import with_landmarks

STATES = 5
MIXED = (0.5, 2)
"""A tuple of two types, whose index must be a constant."""


def walk(x, u, p, dt, out):
    for k in range(STATES):
        out[k] = x[k] + dt * p[0] * (x[k - 1] - x[k])


def affine(state, gain, offset):
    def h(x, u, p, out):
        out[0] = gain * np.sin(x[state]) + offset

    return h


def weighted(weights, pair):
    def h(x, u, p, out):
        out[0] = pair[1] * x[pair[0]]
        for k in range(weights.size):
            out[0] += weights[k] * x[k]

    return h


def of_mixed(k, gain):
    def h(x, u, p, out):
        out[0] = gain * x[0] + MIXED[k]

    return h


def placed(x, u, p, place, out):
    out[0] = place[1] * x[int(place[0])]


def model(count, *kinds):
    """A sensor for each of `count` channels of each kind, whose numbers are random."""
    rng = np.random.default_rng(4)
    made = {
        "numbers": lambda k: affine(k % STATES, float(rng.normal()), k if k % 3 else float(rng.normal())),
        "arrays": lambda k: weighted(rng.normal(size=STATES), (k % STATES, float(rng.normal()))),
        "constants": lambda k: of_mixed(k % 2, float(rng.normal())),
    }
    row = (Row("y", "m", 0.1),)
    sensors = [Sensor(f"{kind}{k}", row, h=made[kind](k)) for kind in kinds if kind in made for k in range(count)]
    if "landmarks" in kinds:
        sensors.append(Sensor("at", row, h=placed, place=(("state", "1"), ("gain", "1"))))
    plant = StateSpaceModel(
        name=f"plant {kinds}",
        title="states that exchange",
        states=tuple(State(f"x{k}", "m", 0.1 * k, 1.0) for k in range(STATES)),
        noises=tuple(Noise(f"x{k}", "m²/s", 0.1) for k in range(STATES)),
        parameters=(Parameter("rate", "1/s", 0.1),),
        sensors=tuple(sensors),
        f=walk,
    )
    if "landmarks" in kinds:
        plant = with_landmarks(plant, {"at": {str(k): (k % STATES, rng.normal()) for k in range(count)}})
    return plant


def appended(plant):
    """With a coloured error of each third sensor and an estimated parameter: each h within two wrappers."""
    errors = {name: ColouredError((1.0,), 60.0) for name in plant.sensor_names[::3]}
    return assemble(plant, errors=errors, estimated={"rate": JointParameter(0.1)})


@pytest.mark.parametrize("wrapped", [False, True])
def test_the_predictions_are_those_of_plain_python(wrapped, monkeypatch):
    """Of three sensors of a kind two share code; the first, of a whole number or a coloured error, has its own."""
    monkeypatch.setattr(model_code, "MIN_SHARED", 2)
    plant = model(3, "numbers", "arrays", "constants", "landmarks")
    plant = appended(plant) if wrapped else plant
    compiled = compile_model(plant)
    x, p = 0.3 + np.arange(float(plant.nx)), plant.default_parameters
    shared, own = np.empty(1), np.empty(1)
    for h, sensor in zip(compiled.h, plant.sensors, strict=True):
        h(x, np.zeros(0), p, shared)
        sensor.h(x, np.zeros(0), p, own)
        assert shared[0] == own[0]


def test_the_estimate_is_that_of_code_for_each(monkeypatch):
    """Of the 24 channels 16 have a whole number as their offset: one kind that is shared, and 8 of their own code."""
    plant = model(24, "numbers")
    log, rng = Log.of(plant), np.random.default_rng(5)
    for k, name in enumerate(plant.sensor_names):
        log.add(name, 0.1 * np.arange(4) + 0.001 * k, rng.normal(size=4))
    run = fold("ekf", plant, log).table().to_pandas()
    monkeypatch.setattr(model_code, "MIN_SHARED", 1000)
    _compile.cache_clear()
    assert run.equals(fold("ekf", plant, log).table().to_pandas())


@pytest.mark.parametrize("kind", ["numbers", "arrays", "landmarks"])
def test_more_sensors_compile_nothing_more(kind):
    few, many = (len(compile_model(model(count, kind)).keep_alive) for count in (60, 240))
    assert few == many < 20


def test_code_that_needs_its_constants_is_compiled_for_each():
    few, many = (len(compile_model(model(count, "constants")).keep_alive) for count in (16, 20))
    assert many - few >= 4
