"""Particle and ensemble filters keep to the scratch and the state that they ask for, whatever the sizes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimators.ensemble import analysis, shared
from estimators.fold import Fold
from estimators.log import READING, TICK, Events, Log
from estimators.model.state_space import Field, Noise, Row, Sensor, StateSpaceModel
from estimators.numerics.workspace import declare_layout, size_of
from estimators.registry import ESTIMATORS
from estimators.tuning import Tuning
from tests.estimators.linear_models import random_linear
from tests.models import unchanged
from tests.support import SECOND, folded

GUARD = 16_384
"""Numbers before and after that no filter may touch: more than a block of particles takes."""

PARTICLE = [name for name, entry in ESTIMATORS.items() if entry.family == "particle"]
ENSEMBLE = [name for name, entry in ESTIMATORS.items() if entry.family == "ensemble"]
C = ((1.0, 0.6, -0.3), (0.6, 1.0, 0.2), (-0.3, 0.2, 1.0))


def some(x, u, p, out):
    for k in range(out.size):
        out[k] = x[k]


def linear(nx):
    """A model of nx states with sensors of 1, 2 and 3 rows, the last correlated, in all of which rbpf is linear."""
    model = random_linear(np.random.default_rng(nx), nx, 1).model
    sensors = (*model.sensors[:2], replace(model.sensors[2], correlation=C))
    return replace(model, sensors=sensors, conditionally_linear=model.state_names)


def ring(n, rows):
    """A ring of n states of which the first ones are read."""
    return StateSpaceModel(
        name="ring",
        title="ring",
        states=Field("x", "1", (n,), spacing=0.5, periodic=(True,), std=2.0),
        noises=(Noise("x", "1/s", 0.1),),
        sensors=(Sensor("some", tuple(Row(f"r{k}", "1", 0.5, position=(0.5 * k,)) for k in range(rows)), h=some),),
        f=unchanged,
    )


def readings(model):
    """Whole and with lost rows of every sensor, one that nothing explains, and queries between."""
    rng = np.random.default_rng(0)
    log = Log(model.width)
    for k in range(3):
        for channel, sensor in enumerate(model.sensors):
            y = rng.normal(0, 2, len(sensor.rows))
            if k == 1:
                y[::2] = np.nan
            if k == 2:
                y[:] = 1e200
            t = (k + 1) * SECOND // 10
            log.extend(Events.one(t, t, READING, channel, y, model.width))
        log.extend(Events.one(t + SECOND // 20, t, TICK, 0, [], model.width))
    return log


def guarded(array, size):
    """A copy of the first numbers of an array with guards around it, and the whole."""
    whole = np.full(size + 2 * GUARD, np.pi)
    whole[GUARD : GUARD + size] = array[:size]
    return whole[GUARD : GUARD + size], whole


def check(name, model, options):
    """Fold with exactly what the entry asks for, between guards, which must stay; the results are those without."""
    entry = ESTIMATORS[name]
    tuning = Tuning.of(model).with_options(options)
    log = readings(model)
    free = folded(name, model, log, tuning)
    fold = Fold(name, model, tuning, log)
    work = entry.work_size(fold.options, model.nx, model.width)
    size = fold._now.state.size
    fold.machine.work, *wholes = guarded(fold.machine.work, work)
    state, whole = guarded(fold._now.state, size)
    fold._spare, spare = guarded(fold._spare, size)
    fold._now = fold._now._replace(state=state)
    wholes += [whole, spare]
    assert fold._now.state.size == entry.state_size(fold.options, model.nx)
    fold.advance()
    for whole in wholes:
        assert np.all(whole[:GUARD] == np.pi) and np.all(whole[-GUARD:] == np.pi)
    np.testing.assert_array_equal(fold._now.state, free._now.state)


@pytest.mark.parametrize("room", ["particle", "ensemble"])
def test_no_filter_takes_an_address(room):
    """Views of arrays come from layouts, vector instructions take arrays: raw pointers stay inside numerics/."""
    for path in (Path(shared.__file__).parent.parent / room).glob("*.py"):
        assert "ctypes" not in path.read_text(), path.name


@pytest.mark.parametrize("name", PARTICLE)
@pytest.mark.parametrize("nx", [1, 2, 7])
@pytest.mark.parametrize("n", [2, 63, 65, 1024, 2049])
def test_particle_filters_keep_to_their_room(name, nx, n):
    for scheme in (0, 3):
        options = {"particles": n, "resampling": scheme} | ({} if name == "apf" else {"fraction": 1.0})
        check(name, linear(nx), options)


@pytest.mark.parametrize("name", PARTICLE)
def test_particle_filters_on_threads_keep_to_their_room(name):
    check(name, linear(2), {"particles": 17_000})


@pytest.mark.parametrize("name", ENSEMBLE)
@pytest.mark.parametrize("nx", [1, 2, 7])
@pytest.mark.parametrize("n", [2, 3, 5, 40])
def test_ensemble_filters_keep_to_their_room(name, nx, n):
    check(name, linear(nx), {"members": n, "inflation": 1.1, "additive": 0.1})


@pytest.mark.parametrize("crews", [1, 3])
@pytest.mark.parametrize("radius", [0.0, 2.0])
@pytest.mark.parametrize(("n", "rows", "members"), [(9, 4, 3), (40, 12, 5), (75, 3, 20), (32, 32, 2)])
@pytest.mark.parametrize("name", ENSEMBLE)
def test_localised_ensemble_filters_keep_to_their_room(name, n, rows, members, radius, crews, monkeypatch):
    for module in (shared, analysis):
        monkeypatch.setattr(module, "crews", lambda numbers, start: crews)
    options = {"members": members, "inflation": 1.1} | ({"radius": radius} if name != "etkf" else {"rotation": 1})
    check(name, ring(n, rows), options)


def test_a_field_of_a_layout_may_have_any_name():
    """Names of the generated function are its own: a field `kind` once took the place of the tuple."""
    _, layout_of = declare_layout("Named", "n", kind="1", made="n", at="n, 2", place="n = made")
    assert size_of(layout_of, 3) == 1 + 3 + 6
