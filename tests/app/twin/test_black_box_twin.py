"""A black box in a file beside its twin's YAML: no other process can import it by its name, and yet runs it."""

import os
import pickle
import sys

import numpy as np
import pytest

from app.twin.twin import load_twin
from estimators.errors import ModelError
from estimators.fold import fold
from estimators.log import READING, Events, Log
from estimators.model.user_file import portable

PHYSICS = "PULL = 0.7\n"
BOX = """\
import os
from functools import partial
from pathlib import Path

import numpy as np
from physics import PULL

from estimators.model import Noise, Row, Sensor, State, StateSpaceModel


def f(X, u, p, dt):
    Path(__file__).with_name(f"{os.getpid()}.pid").touch()
    if dt > 5.0:
        raise ValueError("the step is too long")
    return np.stack((X[:, 0] + dt * X[:, 1], X[:, 1] - dt * FACTOR * PULL * np.sin(X[:, 0])), axis=1)


FACTOR = 1.0


def height(scale, X, u, p):
    return scale * np.cos(X[:, :1])


Box = StateSpaceModel(
    name="box", title="box", states=(State("angle", "rad", 0.8, 0.3), State("rate", "rad/s", 0.0, 0.2)),
    noises=(Noise("rate", "rad2/s3", 0.01),), f=f, black_box=True, executor=EXECUTOR,
    sensors=(Sensor("height", (Row("height", "m", 0.01),), h=partial(height, 2.0)),),
)
"""
YAML = """\
model: ./box.py:Box
estimator: {name: enkf, options: {members: 31}}
source: {type: table, files: drive.csv, time: {column: t, unit: s}, sensors: {height: {columns: y}}}
"""


def run(folder, text, last=2.0):
    (folder / "physics.py").write_text(PHYSICS)
    (folder / "box.py").write_text(text)
    (folder / "box.yaml").write_text(YAML)
    (folder / "drive.csv").write_text("t,y\n0,1.4\n")
    twin = load_twin(str(folder / "box.yaml"))
    log = Log(twin.model.width)
    for seconds in (0.0, 0.5, 1.0, 1.5, last):
        t = round(seconds * 1e9)
        log.extend(Events.one(t, t, READING, 0, [1.4 + 0.2 * np.sin(t)], twin.model.width))
    return fold(twin.estimator, twin.model, twin.tuning, log)


def same(a, b):
    for name, one, other in zip(a._fields, a, b, strict=True):
        np.testing.assert_array_equal(one, other, err_msg=name)


def pids(folder):
    return {path.stem for path in folder.glob("*.pid")}


def test_processes_run_the_models_file_and_give_the_bits_of_threads(tmp_path):
    tracks = {}
    for executor in ("threads", "processes"):
        folder = tmp_path / executor
        folder.mkdir()
        tracks[executor] = run(folder, BOX.replace("EXECUTOR", repr(executor)))
    same(tracks["processes"], tracks["threads"])
    assert np.all(np.isfinite(tracks["threads"].mean))
    assert pids(tmp_path / "threads") == {str(os.getpid())}
    others = pids(tmp_path / "processes")
    assert others and str(os.getpid()) not in others
    assert not list(tmp_path.rglob("__pycache__")), "nothing is left beside the user's files"

    # The processes live on, but a file that was edited is run anew.
    doubled = BOX.replace("FACTOR = 1.0", "FACTOR = 2.0")
    edited = {executor: run(tmp_path / executor, doubled.replace("EXECUTOR", repr(executor))) for executor in tracks}
    same(edited["processes"], edited["threads"])
    assert np.any(edited["threads"].mean != tracks["threads"].mean)

    # What fails there is told with the line of the file.
    line = BOX.splitlines().index('        raise ValueError("the step is too long")') + 1
    with pytest.raises(ModelError, match=rf"processes/box.py:{line}: model box: f fails on .*: ValueError: the step"):
        run(tmp_path / "processes", BOX.replace("EXECUTOR", "'processes'"), last=9.0)


@pytest.mark.parametrize("call", ["os._exit(3)", "os.abort()", "sys.exit(3)"])
@pytest.mark.parametrize("executor", ["threads", "processes"])
def test_a_model_that_would_end_the_program_is_one_line(tmp_path, call, executor):
    text = BOX.replace('raise ValueError("the step is too long")', f"import sys; {call}")
    line = BOX.splitlines().index('        raise ValueError("the step is too long")') + 1
    with pytest.raises(ModelError, match=rf"box.py:{line}: model box: f fails on .*(would end the program|SystemExit)"):
        run(tmp_path, text.replace("EXECUTOR", repr(executor)), last=9.0)


@pytest.mark.parametrize("f", ["lambda X, u, p, dt: X", "Called().f"])
def test_what_has_no_name_in_the_file_is_refused(tmp_path, f):
    called = "class Called:\n    def f(self, X, u, p, dt):\n        return X\n\n\nFACTOR"
    text = (
        BOX.replace("EXECUTOR", "'processes'").replace(" f=f,", f" f={f},").replace("FACTOR = 1.0\n", called + " = 1\n")
    )
    with pytest.raises(
        ModelError, match="model box: f fails on .*processes need functions defined in a module or file, use threads"
    ):
        run(tmp_path, text)


def test_a_partial_finds_its_function_in_the_file_too(tmp_path):
    """In a process that has not run the file yet, which this one is once it has forgotten the module."""
    run(tmp_path, BOX.replace("EXECUTOR", "None"))
    model = load_twin(str(tmp_path / "box.yaml")).model
    sent = pickle.dumps(portable(model.sensors[0].h))
    del sys.modules[model.f.__module__]
    np.testing.assert_array_equal(pickle.loads(sent)(np.array([[0.0, 0.0]]), None, None), [[2.0]])


def test_functions_that_python_finds_go_by_name_alone():
    assert portable(load_twin) is load_twin
    assert portable(np.sin) is np.sin
    assert pickle.loads(pickle.dumps(portable(same))) is same
