"""Which sensor rows are drawn over which states."""

import math

import numpy as np
import pytest

from app.charts.direct_readings import observed
from app.twin.twin import load_twin
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from tests.models import unchanged


@pytest.mark.parametrize(
    "name, expected",
    [
        ("motor_winding", {"winding": "temperature"}),
        ("motor_drive", {"winding": "winding", "tooth": "tooth", "yoke": "yoke"}),
        ("road_car", {"gnss_position.east": "east", "gnss_position.north": "north", "wheel_speed": "speed"}),
    ],
)
def test_readings_are_drawn_over_the_state_that_they_read(name, expected):
    model = MODELS[name]
    found = {
        model.row_names[model.row_start[item.sensor] + item.row]: model.state_names[item.state]
        for item in observed(model)
    }
    assert expected.items() <= found.items()


def test_dots_stand_over_a_state_only_where_a_sensor_reads_it():
    assert {(item.sensor, item.row, item.state) for item in observed(MODELS["motor_winding"])} == {(0, 0, 0)}
    # Its beams grow one for one with the position, and are distances to walls.
    assert observed(MODELS["agv_corridor"]) == []
    car = MODELS["road_car"]
    read = {car.state_names[item.state] for item in observed(car)}
    assert {"east", "north", "heading", "speed"} <= read


@pytest.mark.parametrize("twin", ["road_car", "road_car_rav4"])
def test_position_readings_with_an_error_of_their_own_are_drawn(twin):
    model = load_twin(twin).model
    read = {(model.sensor_names[dot.sensor], model.state_names[dot.state]) for dot in observed(model)}
    assert {("gnss_position", "east"), ("gnss_position", "north"), ("gnss_heading", "heading")} <= read


def h(x, u, p, out):
    out[0] = x[1]
    out[1] = x[0] + x[1]
    out[2] = 1.03 * x[1] + 0.01 * x[0]
    out[3] = np.nan if x[0] > 0.0 else x[0]


def model_of(states, rows, h, *, black_box=False):
    """States and rows of one sensor, named by letters."""
    return StateSpaceModel(
        name="m", title="m", states=tuple(State(name, "m") for name in states), noises=(Noise("a", "m²/s", 1.0),),
        f=identity_of_a_block if black_box else unchanged, black_box=black_box,
        sensors=(Sensor("gauge", tuple(Row(name, "m", 1.0) for name in rows), h),),
    )  # fmt: skip


def test_a_row_that_only_looks_like_a_state_at_the_prior_mean_is_not_one():
    model = model_of("ab", "klmn", h)
    # At the mean, zero, a + b is a and b, with a slope of one; m has a scale and a lever like a real sensor.
    assert [(dot.row, dot.state) for dot in observed(model)] == [(0, 1), (2, 1)]


def identity_of_a_block(X, u, p, dt):
    return X.copy()


def first_of_a_block(X, u, p):
    return X[:, :1]


def raises_beyond_the_mean(x, u, p, out):
    out[0] = x[0] + 0.0 * math.sqrt(0.01 - x[0])
    out[1] = 1.0


def test_a_black_box_is_asked_for_blocks():
    model = model_of("ab", "a", first_of_a_block, black_box=True)
    assert [(item.sensor, item.row, item.state) for item in observed(model)] == [(0, 0, 0)]


def test_a_sensor_that_raises_near_the_prior_has_no_dots(capsys):
    """Machine code gives NaN there, and the twin runs."""
    assert observed(model_of("a", "ab", raises_beyond_the_mean)) == []
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("black_box", [False, True])
def test_a_sensor_that_fails_otherwise_is_named_once(black_box, capsys):
    def h(x, u, p, out=None):
        raise LookupError(f"no table of {black_box}")

    model = model_of("a", "a", h, black_box=black_box)
    assert observed(model) == observed(model) == []
    (line,) = capsys.readouterr().err.splitlines()
    assert all(part in line for part in ("model m", "h of gauge", f"LookupError: no table of {black_box}"))
