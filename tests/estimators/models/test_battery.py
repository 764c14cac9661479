"""The battery models: the circuit against an integrator and SciPy's PCHIP, and what the twins make of their logs."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import PchipInterpolator

from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from estimators.compiled.model import compile_model
from estimators.fold import fold
from estimators.models.battery_cell import BATTERY_CELL, NODES, open_circuit
from estimators.models.battery_pack import BATTERY_PACK, CELLS
from tests.models import complex_step


def named(model) -> dict[str, float]:
    return {item.name: item.value for item in model.parameters}


def spoiled() -> np.ndarray:
    """The pack's parameters, with cells that differ."""
    values = named(BATTERY_PACK)
    rng = np.random.default_rng(3)
    for k in range(1, CELLS + 1):
        values[f"capacity_{k}"] *= rng.uniform(0.8, 1.2)
        values[f"r0_{k}"] *= rng.uniform(0.8, 1.5)
    return np.array(list(values.values()))


def flows(t, x, current, air, values, capacity, r0):
    """The equations of the docstrings, over cells in a row: dx/dt of (z..., V1..., T...)."""
    z, v1, celsius = x.reshape(3, -1)
    g = np.exp(values["activation"] * (1.0 / (celsius + 273.15) - 1.0 / 298.15))
    r1 = values["r1"] * g * (1.0 + values["r1_rise"] * np.exp(-z / 0.05))
    heat = current * (r0 * g * current + v1) - (celsius - air) / values["to_air"]
    passed = np.diff(celsius) / values.get("to_neighbour", np.inf)  # from each cell's successor to it
    heat[:-1] += passed
    heat[1:] -= passed
    dz = -current / (3600.0 * capacity)
    dv1 = (r1 * current - v1) / values["tau_1"]
    return np.concatenate([dz, dv1, heat / values["heat_capacity"]])


def test_the_pack_follows_its_differential_equation() -> None:
    p = spoiled()
    values = dict(zip((item.name for item in BATTERY_PACK.parameters), p, strict=True))
    capacity = np.array([values[f"capacity_{k}"] for k in range(1, CELLS + 1)])
    r0 = np.array([values[f"r0_{k}"] for k in range(1, CELLS + 1)])
    rng = np.random.default_rng(4)
    start = np.concatenate([rng.uniform(0.5, 0.95, CELLS), rng.normal(0, 0.02, CELLS), rng.uniform(15, 40, CELLS)])
    f, u = compile_model(BATTERY_PACK).f, np.array([6.0, 22.0])
    exact = solve_ivp(
        flows, (0, 300), start, args=(*u, values, capacity, r0), method="DOP853", rtol=1e-10, atol=1e-12
    ).y[:, -1]

    def after(dt: float) -> np.ndarray:
        x, out = start.reshape(3, -1).T.ravel().copy(), np.empty(24)
        for _ in range(round(300 / dt)):
            f(x, u, p, dt, out)
            x = out.copy()
        return x.reshape(-1, 3).T.ravel()

    coarse, fine = after(1.0) - exact, after(0.25) - exact
    np.testing.assert_allclose(coarse[:CELLS], 0.0, atol=1e-12)  # counting a held current is exact
    # R1 is held over a step: an error of half a step of its change, 300 s of which are a tenth of 0.2 V.
    np.testing.assert_allclose(coarse[CELLS : 2 * CELLS], 0.0, atol=1e-4)
    # Euler: half a step times the heating rate, at most 0.05 K/s; and of first order.
    np.testing.assert_allclose(coarse[2 * CELLS :], 0.0, atol=0.025)
    assert np.abs(fine).max() == pytest.approx(np.abs(coarse).max() / 4, rel=0.1)


def test_a_cell_of_the_pack_alone_is_the_cell() -> None:
    shared = named(BATTERY_CELL)
    values = named(BATTERY_PACK) | {"to_neighbour": 1e30}
    x, u = np.array([0.4, 0.03, 31.0]), np.array([-4.0, 20.0])
    one, all_of_them = np.empty(3), np.empty(24)
    compile_model(BATTERY_CELL).f(x, u, np.array(list(shared.values())), 1.0, one)
    compile_model(BATTERY_PACK).f(np.tile(x, CELLS), u, np.array(list(values.values())), 1.0, all_of_them)
    np.testing.assert_allclose(all_of_them, np.tile(one, CELLS), rtol=1e-14)


def test_heat_that_cells_pass_to_each_other_cancels() -> None:
    values = named(BATTERY_PACK)
    p = np.array(list(values.values()))
    rng = np.random.default_rng(6)
    x, out = np.tile([0.5, 0.01, 0.0], CELLS), np.empty(24)
    x[2::3] = rng.uniform(10.0, 50.0, CELLS)
    compile_model(BATTERY_PACK).f(x, np.array([0.0, 20.0]), p, 1.0, out)
    stored = values["heat_capacity"] * np.sum(out[2::3] - x[2::3])
    assert stored == pytest.approx(-np.sum(x[2::3] - 20.0) / values["to_air"], rel=1e-10)


def test_open_circuit_is_scipys_monotone_cubic_with_its_slope() -> None:
    p = BATTERY_CELL.default_parameters
    volts = p[: len(NODES)]
    assert (np.diff(volts) > 0).all()
    inner = np.linspace(NODES[1], NODES[-2], 400)  # at both ends PCHIP takes slopes of another kind
    pchip = PchipInterpolator(NODES, volts)
    got = np.array([open_circuit(z, p) for z in inner])
    np.testing.assert_allclose(got[:, 0], pchip(inner), rtol=0, atol=1e-13)
    np.testing.assert_allclose(got[:, 1], pchip(inner, 1), rtol=0, atol=1e-10)
    everywhere = np.linspace(-0.2, 1.2, 1401)
    values, slopes = np.array([open_circuit(z, p) for z in everywhere]).T
    assert (np.diff(values) > 0).all() and (slopes > 0).all()
    # Continuous, value and slope, over every node and both ends.
    edges = np.array([open_circuit(z + s, p) for z in NODES for s in (-1e-9, 1e-9)]).reshape(-1, 2, 2)
    np.testing.assert_allclose(edges[:, 0], edges[:, 1], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("soc", [-0.1, 0.01, 0.5, 1.05])
@pytest.mark.parametrize("model", [BATTERY_CELL, BATTERY_PACK], ids=lambda model: model.name)
def test_slopes_match_complex_step_from_below_empty_to_above_full(model, soc: float) -> None:
    rng = np.random.default_rng(7)
    compiled = compile_model(model)
    p = spoiled() if model is BATTERY_PACK else model.default_parameters
    n = model.nx
    x = np.tile([soc, 0.02, 30.0], n // 3) + rng.normal(0, 1, n) * np.tile([2e-3, 0.01, 5.0], n // 3)
    u = np.array([7.0, 20.0])
    checks = [(lambda z, out: compiled.f(z, u, p, 1.5, out), lambda J: model.F(x, u, p, 1.5, J), n)]
    for k, sensor in enumerate(model.sensors):
        h, H = compiled.h[k], sensor.H
        checks.append((lambda z, out, h=h: h(z, u, p, out), lambda J, H=H: H(x, u, p, J), len(sensor.rows)))
    for function, slope, rows in checks:
        own = np.full((rows, n), np.nan)
        slope(own)
        np.testing.assert_allclose(own, complex_step(function, x, rows), rtol=1e-11, atol=1e-13)


def test_lost_capacity_is_found_when_it_is_estimated() -> None:
    twin = load_twin(
        "battery_pack",
        overrides={
            "parameters": "{r0_5: 0.042, capacity_5: {std: 0.3, role: estimated}}",
            "noise.soc": "{variance: 1e-11}",
            "noise.v1": "{variance: 1e-7}",
        },
    )
    log, _ = read_log(twin, None)
    track = fold("ekf", twin.model, twin.tuning, log)
    assert twin.model.state_names[-1] == "capacity_5"
    assert track.mean[0, -1] == pytest.approx(2.9)
    assert track.mean[-1, -1] == pytest.approx(2.54, abs=0.1)
