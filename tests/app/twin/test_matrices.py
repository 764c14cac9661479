"""Twins whose model is a file of matrices: the same estimates as the model in Python, and one line for each fault."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from app.twin.twin import load_twin
from config import extensions
from config.loader import moved
from estimators.errors import NisusError
from estimators.fold import fold
from estimators.log import INPUT, READING, Events, Log
from tests.support import error_of

PYTHON = """\
from estimators.model import Input, Noise, Row, Sensor, State, StateSpaceModel

def f(x, u, p, dt, out):
    out[0] = x[0] + dt * x[1] + 0.5 * dt * dt * u[0]
    out[1] = x[1] + dt * u[0]


def Q(x, u, p, q, dt, out):
    out[0, 0] = q[0] * dt + q[1] * dt**3 / 3.0
    out[0, 1] = out[1, 0] = q[1] * dt**2 / 2.0
    out[1, 1] = q[1] * dt


def gauge(x, u, p, out):
    out[0] = x[0]


def wheel(x, u, p, out):
    out[0] = 2.0 * x[1]
    out[1] = x[1] + 0.1 * u[0]


Cart = StateSpaceModel(
    name="cart", title="cart", states=(State("position", "m"), State("speed", "m/s")), inputs=(Input("push", "m/s2"),),
    noises=(Noise("position", "m²/s", 0.0), Noise("speed", "m²/s³", 0.0)), f=f, Q=Q, linear=True,
    sensors=(
        Sensor("gauge", (Row("gauge", "m", 1.0),), h=gauge),
        Sensor("wheel", (Row("turn", "rad/s", 1.0), Row("roll", "m/s", 1.0)), h=wheel),
    ),
)
"""
CONTINUOUS = {
    "A": np.array([[0.0, 1.0], [0.0, 0.0]]),
    "B": np.array([[0.0], [1.0]]),
    "C": np.array([[1.0, 0.0], [0.0, 2.0], [0.0, 1.0]]),
    "D": np.array([[0.0], [0.0], [0.1]]),
}
DISCRETE = CONTINUOUS | {"A": np.array([[1.0, 0.5], [0.0, 1.0]]), "B": np.array([[0.125], [0.5]]), "dt": 0.5}
MODEL = """\
model:
  matrices: FILE
  states: {position: m, speed: m/s}
  inputs: {push: m/s2}
  sensors: {gauge: m, wheel: {turn: rad/s, roll: m/s}}
"""
REST = """\
prior: {position: {mean: 1, std: 2}, speed: {std: 0.5}}
noise: {position: {variance: 0.01}, speed: {variance: 0.04}}
sensors: {gauge: {std: 0.1}, wheel: {std: [0.2, 0.3]}}
estimator: kf
source: {type: table, files: drive.csv, time: {column: t}, sensors: {gauge: {columns: y}}}
"""


def twin(folder: Path, model: str = MODEL, rest: str = REST, file: str = "cart.npz", arrays=CONTINUOUS):
    if file.endswith(".npz"):
        np.savez(folder / file, **arrays)
    elif file.endswith(".mat"):
        savemat(folder / file, arrays)
    (folder / "drive.csv").write_text("t,y\n0,1.4\n")
    (folder / "cart.yaml").write_text(model.replace("FILE", file) + rest)
    return load_twin(str(folder / "cart.yaml"))


def track(made):
    log, width = Log(made.model.width), made.model.width
    rng = np.random.default_rng(0)
    t = 0
    for k in range(40):
        t += int(rng.integers(10**7, 10**9))
        log.extend(Events.one(t, t, INPUT, 0, [float(rng.normal())], width))
        log.extend(Events.one(t, t, READING, k % 2, rng.normal(size=1 + k % 2), width))
    return fold(made.estimator, made.model, made.tuning, log)


@pytest.fixture(scope="module")
def in_python(tmp_path_factory):
    folder = tmp_path_factory.mktemp("python")
    (folder / "cart.py").write_text(PYTHON)
    return track(twin(folder, "model: ./cart.py:Cart\n", file=""))


@pytest.mark.parametrize("file", ["cart.npz", "cart.mat"])
@pytest.mark.parametrize("arrays", [CONTINUOUS, DISCRETE], ids=["continuous", "discrete"])
def test_estimates_are_those_of_the_model_in_python(tmp_path, in_python, file, arrays):
    made = twin(tmp_path, file=file, arrays=arrays)
    assert [(s.name, s.unit, s.mean, s.std) for s in made.model.states] == [
        ("position", "m", 1.0, 2.0),
        ("speed", "m/s", 0.0, 0.5),
    ]
    assert [row.unit for row in made.model.sensors[1].rows] == ["rad/s", "m/s"]
    found = track(made)
    for name in ("mean", "std", "innovation", "nis", "log_likelihood"):
        # Rounding of 40 steps; that of the matrix logarithm too where the model is discrete.
        np.testing.assert_allclose(getattr(found, name), getattr(in_python, name), rtol=1e-10, atol=1e-12, err_msg=name)


def test_keys_and_sample_time_of_the_yaml_come_first(tmp_path, in_python):
    arrays = {"Phi": DISCRETE["A"], "Gamma": DISCRETE["B"], "H": DISCRETE["C"], "D": DISCRETE["D"], "dt": 7.0}
    model = MODEL + "  keys: {A: Phi, B: Gamma, C: H}\n  sample_time: 0.5\n"
    np.testing.assert_allclose(track(twin(tmp_path, model, arrays=arrays)).mean, in_python.mean, rtol=1e-10, atol=1e-12)


def test_the_file_is_read_again_and_found_from_a_copy(tmp_path):
    made = twin(tmp_path)
    assert tmp_path / "cart.npz" in made.files
    text = (tmp_path / "cart.yaml").read_text()
    assert 'matrices: "../cart.npz"' in moved(text, tmp_path / "cart.yaml", tmp_path / "copies" / "cart.yaml")


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"model": MODEL.replace("FILE", "other.npz")}, r"cart.yaml:2: model.matrices is 'other.npz'; there is"),
        ({"file": "cart.txt"}, r"cart.yaml:2: model.matrices is 'cart.txt'; (there is no file|it must be a .mat)"),
        ({"model": MODEL + "  keys: {A: Phi}\n"}, r"cart.yaml:6: model.keys.A is 'Phi'; .* no array of that name"),
        ({"arrays": CONTINUOUS | {"A": np.array([["a"]])}}, r"model.keys.A is 'A', in .*cart.npz no matrix of"),
        ({"arrays": CONTINUOUS | {"A": np.array([{}])}}, r"cart.npz: it cannot be read \(Object arrays"),
        ({"arrays": CONTINUOUS | {"B": np.ones((2, 2))}}, r"cart.npz: model cart: B has shape \(2, 2\); 2 states"),
        ({"arrays": DISCRETE | {"A": np.diag([0.0, 1.0])}}, r"cart.npz: model cart: A has the eigenvalue 0, a delay"),
        ({"model": "model: {states: {x: m}}\n"}, r"cart.yaml:1: model names .*matrices"),
        ({"model": MODEL + "  step: 0.1\n"}, r"cart.yaml:6: model.step is not known"),
        ({"rest": REST.replace(", speed: {std: 0.5}", "")}, r"prior has no std of speed, and a file of"),
        ({"rest": REST.replace(", wheel: {std: [0.2, 0.3]}", "")}, r"cart.yaml:8: sensors has no std of wheel"),
        ({"rest": REST.replace("noise:", "x-noise:")}, r"noise is missing"),
    ],
)  # fmt: skip
def test_every_fault_is_one_line(tmp_path, given, says):
    (tmp_path / "cart.txt").write_text("")
    assert re.search(says, error_of(NisusError, twin, tmp_path, **given))


def test_a_model_of_no_known_kind_names_the_extensions_that_cannot_be_loaded(tmp_path, monkeypatch):
    monkeypatch.setitem(extensions._left_out, "ode", "no module ode")
    said = error_of(NisusError, twin, tmp_path, model="model: {ode: cart.ode}\n")
    assert re.search(r"^\S*cart.yaml:1: model names .*matrices.*; ext.* loaded: .*\bode \(no module ode\)$", said)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("cart.npz", b"PK\x03\x04 damaged", "cart.npz: it cannot be read"),
        ("cart.mat", b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(64), "wrote it as v7.3.*'-v7'"),
        ("cart.mat", b"", "cart.mat: it cannot be read"),
    ],
)
def test_files_that_cannot_be_read(tmp_path, name, content, says):
    twin(tmp_path, file=name)
    (tmp_path / name).write_bytes(content)
    assert re.search(says, error_of(NisusError, load_twin, str(tmp_path / "cart.yaml")))
