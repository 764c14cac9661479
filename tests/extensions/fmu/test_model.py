"""Twins whose model is an FMU: integrated as by SciPy, filtered as the same black box in Python, checked on load."""

import gc
import json
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from app.twin.twin import load_twin
from estimators.errors import NisusError
from estimators.fold import fold
from estimators.log import INPUT, READING, Events, Log
from tests.cases import cases
from tests.support import error_of

from .fmus import build

PYTHON = """\
import numpy as np

from estimators.model import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel


def rate(X, u, p):
    a, b = X.T
    return np.stack((b, p[0] * (1.0 - a * a) * b - a + u[0]), axis=1)


def f(X, u, p, dt):
    k1 = rate(X, u, p)
    k2 = rate(X + 0.5 * dt * k1, u, p)
    k3 = rate(X + 0.5 * dt * k2, u, p)
    return X + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(X + dt * k3, u, p))


def both(X, u, p):
    return np.stack((X[:, 0], X[:, 0] + 0.5 * u[0]), axis=1)


Box = StateSpaceModel(
    name="box", title="box", states=(State("x0", "m", 2.0), State("speed", "m/s", 0.0)), inputs=(Input("push", "N"),),
    parameters=(Parameter("mu", "1", 1.0, 0.0, 9.0),), noises=(Noise("x0", "m²/s", 0.0), Noise("speed", "m²/s³", 0.0)),
    f=f, sensors=(Sensor("pair", (Row("x", "m", 1.0), Row("both", "m", 1.0)), h=both),), black_box=True, max_step=0.02,
)
"""
FMU = """\
model:
  fmu: FILE
  step: 0.02
  states: {speed: "car.v[1]"}
  parameters: [mu]
  sensors: {pair: {x: x0, both: both}}
  units: {both: m}
"""
REST = """\
parameters: {mu: 1.3}
prior: {x0: {std: 0.5}, speed: {std: 0.3}}
noise: {x0: {variance: 0.001}, speed: {variance: 0.02}}
sensors: {pair: {std: 0.1}}
estimator: filterpy-ukf
source: {type: table, files: drive.csv, time: {column: t}, sensors: {pair: {columns: [y, z]}}}
"""


@pytest.fixture(scope="module", params=[2, 3], ids=["FMI 2", "FMI 3"])
def fmu(request, tmp_path_factory) -> Path:
    return build(tmp_path_factory.mktemp("fmu"), version=request.param)


def twin(folder: Path, file: Path | str, model: str = FMU, rest: str = REST):
    (folder / "drive.csv").write_text("t,y,z\n0,1.4,1.4\n")
    (folder / "box.yaml").write_text(model.replace("FILE", str(file)) + rest)
    return load_twin(str(folder / "box.yaml"))


def refused(folder: Path, file: Path | str, model: str = FMU, rest: str = REST) -> str:
    return error_of(NisusError, twin, folder, file, model, rest)


def test_names_units_and_start_values_are_those_of_the_description(tmp_path, fmu):
    model = twin(tmp_path, fmu).model
    assert [(s.name, s.unit, s.mean, s.std) for s in model.states] == [
        ("x0", "m", 2.0, 0.5),
        ("speed", "m/s", 0.0, 0.3),
    ]
    assert [(item.name, item.unit) for item in model.inputs] == [("push", "N")]
    assert [(p.name, p.value, p.low, p.high) for p in model.parameters] == [("mu", 1.3, 0.0, 9.0)]
    assert [(row.name, row.unit) for row in model.sensors[0].rows] == [("x", "m"), ("both", "m")]
    assert model.title == "VANDERPOL" and model.max_step == 0.02
    own = FMU.replace('  states: {speed: "car.v[1]"}\n', "").replace("  sensors: {pair: {x: x0, both: both}}\n", "")
    rest = REST.replace("speed", "car_v_1").replace("pair: {std: 0.1}", "x0: {std: 1}, both: {std: 1}")
    model = twin(tmp_path, fmu, own, rest.replace("pair: {columns: [y, z]}", "x0: {columns: y}")).model
    assert model.state_names == ("x0", "car_v_1") and model.sensor_names == ("x0", "both")


def test_steps_are_those_of_scipy(tmp_path, fmu):
    model = twin(tmp_path, fmu).model
    u, p = np.array([0.4]), np.array([1.3])
    X = np.array([[2.0, 0.0], [-1.0, 0.5], [0.3, -2.0]])
    after = X
    for _ in range(150):
        after = model.f(after, u, p, 0.02)

    def rates(_, x):
        return x[1], p[0] * (1.0 - x[0] ** 2) * x[1] - x[0] + u[0]

    exact = [solve_ivp(rates, (0.0, 3.0), x, rtol=1e-11, atol=1e-12).y[:, -1] for x in X]
    # Runge-Kutta of fourth order: (0.02)^4 = 1.6e-7 times derivatives of order 10.
    np.testing.assert_allclose(after, exact, atol=3e-6)
    np.testing.assert_allclose(model.sensors[0].h(X, u, p), np.stack((X[:, 0], X[:, 0] + 0.2), axis=1), rtol=1e-15)


def track(made):
    log, width = Log(made.model.width), made.model.width
    rng = np.random.default_rng(0)
    for k in range(30):
        t = k * 10**8 + int(rng.integers(10**7))
        log.extend(Events.one(t, t, INPUT, 0, [float(rng.normal())], width))
        log.extend(Events.one(t, t, READING, 0, 2.0 * np.cos(1e-9 * t) + rng.normal(size=2) * 0.1, width))
    return fold(made.estimator, made.model, made.tuning, log)


@pytest.mark.parametrize("filter", ["filterpy-ukf", "enkf", "{name: pf, options: {particles: 60}}"])
def test_estimates_are_those_of_the_black_box_in_python(tmp_path, fmu, filter):
    (tmp_path / "box.py").write_text(PYTHON)
    rest = REST.replace("filterpy-ukf", filter)
    theirs, ours = (
        track(twin(tmp_path, file, model, rest)) for file, model in ((fmu, FMU), ("", "model: ./box.py:Box\n"))
    )
    assert np.all(np.isfinite(ours.mean))
    for name in ("mean", "std", "innovation", "log_likelihood"):
        np.testing.assert_allclose(getattr(theirs, name), getattr(ours, name), rtol=1e-9, atol=1e-9, err_msg=name)


def test_another_parameter_initialises_the_instance_again(tmp_path):
    file = build(tmp_path, "DAHLQUIST")
    model = FMU.replace('  states: {speed: "car.v[1]"}\n', "")
    rest = REST.replace(", speed: {std: 0.3}", "").replace(", speed: {variance: 0.02}", "")
    f = twin(tmp_path, file, model, rest).model.f
    x, u = np.array([[2.0]]), np.zeros(1)
    for k in (0.5, 2.0, 0.5):
        np.testing.assert_allclose(f(x, u, np.array([k]), 0.02), 2.0 * np.exp(-0.02 * k), rtol=1e-8)


@pytest.mark.parametrize("version", [2, 3])
def test_a_state_at_which_it_fails_is_nan_and_the_next_one_is_not(tmp_path, version):
    f = twin(tmp_path, build(tmp_path, flaw="BEYOND", version=version)).model.f
    given = np.zeros(1), np.ones(1), 0.01
    X = np.array([[2.0, 0.0], [6.0, 0.0], [1.0, 0.0], [np.nan, 0.0]])
    after = f(X, *given)
    assert np.isfinite(after).all(axis=1).tolist() == [True, False, True, False]
    np.testing.assert_array_equal(after[[0, 2]], f(X[[0, 2]], *given))
    with pytest.raises(NisusError, match=r"vanderpolbeyond\d.fmu: fmi\dGet.* failed with status 3"):
        f(X[1:2], *given)


@pytest.mark.parametrize("version", [2, 3])
def test_events_act_at_the_ends_of_steps(tmp_path, version):
    model = twin(tmp_path, build(tmp_path, "BOUNCE", version=version, events=1)).model
    given = np.zeros(1), np.ones(1), 0.02
    X = np.array([[0.05, -4.0], [1.0, 0.0], [-0.1, -2.0]])
    after = model.f(X, *given)
    free = X[1] + [-0.5 * 9.81 * 0.02**2, -9.81 * 0.02]
    np.testing.assert_allclose(
        after, [[0.0, 0.5 * (4.0 + 9.81 * 0.02)], free, [0.02 - 0.5 * 9.81 * 4e-4, 1.0 - 0.1962]]
    )


@cases(__file__, "needs.csv")
def test_what_a_filter_needs_is_checked_on_load(tmp_path, given, says):
    said = refused(tmp_path, build(tmp_path, **json.loads(given)))
    assert says in said and ".fmu: " in said


@cases(__file__, "names.csv")
def test_what_the_yaml_may_not_name(tmp_path, old, new, says):
    assert says in refused(tmp_path, build(tmp_path), FMU.replace(old, new))


def test_other_files_and_other_platforms(tmp_path):
    (tmp_path / "text.fmu").write_text("no zip file")
    assert "text.fmu: it is no readable FMU" in refused(tmp_path, "text.fmu")
    file = build(tmp_path)
    file.write_bytes(file.read_bytes().replace(b"binaries/linux64", b"binaries/win6432"))
    assert "it has no binary for linux64 (it has win6432)" in refused(tmp_path, file)
    here = Path.cwd()
    with zipfile.ZipFile(build(tmp_path)) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(tmp_path / "broken.fmu", "w") as archive:
        for name, content in contents.items():
            archive.writestr(name, b"no library" if name.endswith(".so") else content)
    assert "broken.fmu: it cannot be loaded: Failed to load shared library" in refused(tmp_path, "broken.fmu")
    assert Path.cwd() == here
    assert "prior has no std of x0, and an FMU has none" in refused(
        tmp_path, build(tmp_path), rest=REST.replace("x0: {std: 0.5}, ", "")
    )


@pytest.mark.parametrize("version", [2, 3])
def test_an_instance_is_freed_with_its_model(tmp_path, version):
    model = twin(tmp_path, build(tmp_path, version=version)).model
    folder = model.f.__self__._folder.name
    assert Path(folder).is_dir() and folder in Path("/proc/self/maps").read_text()
    del model
    gc.collect()
    assert not Path(folder).exists() and folder not in Path("/proc/self/maps").read_text()


def test_the_extra_is_named(tmp_path, monkeypatch):
    file = build(tmp_path, "VANDERPOL")
    monkeypatch.setitem(sys.modules, "fmpy", None)
    assert "box.yaml:2: model.fmu needs FMPy: pip install 'nisus[fmu]'" in refused(tmp_path, file)
