"""Plain Python helpers of a model's functions: compiled with them, wherever they stand, and anew when they change."""

import importlib
import os
import pickle
import sys

import numpy as np
import pytest

from estimators.compiled.model import compile_model
from estimators.errors import ModelError
from estimators.fold import fold
from estimators.log import READING
from estimators.model.assemble import JointParameter, joint
from estimators.model.state_space import Parameter
from estimators.numerics.helpers import with_helpers
from estimators.numerics.jit import jit
from estimators.tuning import Tuning
from tests.models import level_model
from tests.support import log_of

LIMIT = 41.0


def capped(a):
    return min(a, LIMIT)


def decay(a, rate, dt):
    return capped(a) * np.exp(-rate * dt)


def f(x, u, p, dt, out):
    out[0] = decay(x[0], p[0], dt)


def h(x, u, p, out):
    out[0] = capped(x[0])


def f_in_one(x, u, p, dt, out):
    out[0] = min(x[0], 41.0) * np.exp(-p[0] * dt)


def h_in_one(x, u, p, out):
    out[0] = min(x[0], 41.0)


def tank(f=f, h=h):
    parameters = (Parameter("rate", "1/s", 0.1, 0.0, 1.0),)
    return level_model({"gauge": 1.0}, 0.1, mean=40.0, std=5.0, f=f, h=h, parameters=parameters)


def log():
    return log_of(2, *((k, READING, value) for k, value in enumerate((40.0, 38.0, 35.0, 31.0))))


@pytest.mark.parametrize("name", ("ekf", "ukf", "pf"))
@pytest.mark.parametrize("unknown", (False, True))
def test_a_model_with_helpers_is_the_same_model(name, unknown):
    tracks = []
    for model in (tank(), tank(f_in_one, h_in_one)):
        model = joint(model, {"rate": JointParameter(0.01, 1e-6)}) if unknown else model
        tracks.append(fold(name, model, Tuning.of(model), log()))
    np.testing.assert_allclose(tracks[0].mean, tracks[1].mean, rtol=1e-12)
    np.testing.assert_allclose(tracks[0].std, tracks[1].std, rtol=1e-9)


def test_a_helper_in_a_closure_is_compiled_too():
    def third(a):
        return a / 3.0

    def own(x, u, p, dt, out):
        out[0] = third(x[0])

    out = np.empty(1)
    compile_model(tank(own)).f(np.array([6.0]), np.zeros(0), np.array([0.1]), 1.0, out)
    assert out[0] == 2.0


def scaled(factor):
    def helper(a):
        return factor * a

    def outer(a):
        return helper(a) + 1.0

    return outer


def test_helpers_of_one_source_that_enclose_other_values_are_told_apart():
    """Also where the machine code of the first is in the cache."""
    found = [jit(with_helpers(scaled(factor)))(10.0) for factor in (2.0, 3.0, 2.0)]
    assert found == [21.0, 31.0, 21.0]


def test_helpers_sent_to_another_process_keep_the_values_they_enclose():
    """Numba finds a function that it unpickles by its identifier, which must depend on enclosed values."""
    two, three = (jit(with_helpers(scaled(factor))) for factor in (2.0, 3.0))
    kept = [pickle.loads(pickle.dumps(helper_of(outer))) for outer in (two, three)]
    assert [helper(10.0) for helper in kept] == [20.0, 30.0]


def helper_of(outer):
    [cell] = outer.py_func.__closure__
    return cell.cell_contents


def test_functions_without_helpers_are_left_as_they_are():
    assert with_helpers(f_in_one) is f_in_one


def test_a_helper_in_another_file_is_compiled_anew_when_it_changes(tmp_path, monkeypatch):
    """Numba looks at the file of the function alone, which stays the same."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    text = "from own_helper import part\ndef own(x, u, p, dt, out):\n    out[0] = part(x[0])\n"
    (tmp_path / "own_model.py").write_text(text)
    told = []
    for factor in ("2.0", "5.0"):
        (tmp_path / "own_helper.py").write_text(f"def part(a):\n    return {factor} * a\n")
        os.utime(tmp_path / "own_helper.py", (1.0, float(factor)))
        for module in ("own_model", "own_helper"):
            sys.modules.pop(module, None)
        importlib.invalidate_caches()
        out = np.empty(1)
        compile_model(tank(importlib.import_module("own_model").own)).f(
            np.array([3.0]), np.zeros(0), np.array([0.1]), 1.0, out
        )
        told.append(out[0])
    assert told == [6.0, 15.0]


def test_what_cannot_be_compiled_says_how_to_mend_it(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "module_helper.py").write_text("def part(a):\n    return a\n")
    text = "import module_helper\ndef own(x, u, p, dt, out):\n    out[0] = module_helper.part(x[0])\n"
    (tmp_path / "module_model.py").write_text(text)
    with pytest.raises(ModelError, match="module_model.py:3: .*'part'.*; import the function that it calls"):
        compile_model(tank(importlib.import_module("module_model").own))
