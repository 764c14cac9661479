"""A model that disagrees with its declaration is refused with one line that says what, where and how much."""

import itertools
import random as other
import time
from random import gauss

import numpy as np
import pytest

from estimators.compiled.model import compile_model
from estimators.errors import ModelError
from estimators.model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from tests.estimators.compiled.test_jacobians import F, H, P, U, f, h, model
from tests.models import first_state, first_state_squared, unchanged
from tests.support import error_of

NOT_COMPILABLE = {"a": 1}


def wrong_F(x, u, p, dt, out):
    F(x, u, p, dt, out)
    out[1, 2] *= -1.0


def wrong_H(x, u, p, out):
    H(x, u, p, out)
    out[0, 2] *= 1.01


def leaves_out(x, u, p, dt, out):
    out[0] = x[0]
    out[2] = x[2]


def divides_by_zero(x, u, p, dt, out):
    out[0] = np.log(-x[2])
    out[1] = x[1]
    out[2] = x[2]


def reads_too_far(x, u, p, dt, out):
    out[0] = x[3]


def writes_too_far(x, u, p, dt, out):
    for i in range(4):
        out[i] = 0.0


def reads_a_parameter_too_far(x, u, p, dt, out):
    out[0] = p[2]


def raises(x, u, p, dt, out):
    raise ValueError("no such state")


def uses_python(x, u, p, dt, out):
    for i in range(3):
        out[i] = x[i] * getattr(NOT_COMPILABLE, "get")("a")  # noqa: B009


def misspelt(x, u, p, dt, out):
    out[0] = np.sqqrt(x[0])


def returns_too_many(x, u, p, dt, out):
    out[:] = np.zeros(4)


def too_few_arguments(x, out):
    out[0] = x[0]


def tiny_lopsided_Q(x, u, p, q, dt, out):
    for i in range(3):
        out[i, i] = 1e-9
    out[0, 1] = 1e-10


def lopsided_Q(x, u, p, q, dt, out):
    out[0, 1] = q[0] * dt


def h_writes_too_far(x, u, p, out):
    for i in range(3):
        out[i] = x[i]


def writes_to_x(x, u, p, dt, out):
    x[0] += dt * x[1]
    for i in range(3):
        out[i] = x[i]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"f": writes_to_x}, ("f writes to its argument x", "fill out only")),
        ({"F": wrong_F}, ("F differs", "(relative)")),
        ({"H": wrong_H}, ("H of sensor s differs", "(relative)")),
        ({"f": leaves_out}, ("f leaves 1 of 3", "unset", "fill them all")),
        ({"f": divides_by_zero}, ("f leaves 1 of 3", "not finite at the prior")),
        ({"f": reads_too_far}, ("f fails at the prior", "3 states", "IndexError")),
        ({"f": writes_too_far}, ("f fails at the prior", "IndexError")),
        ({"f": reads_a_parameter_too_far}, ("f fails at the prior", "2 parameters", "IndexError")),
        ({"f": raises}, ("f fails at the prior", "ValueError: no such state; it may not fail at x = [")),
        ({"f": misspelt}, ("f fails at the prior", "sqqrt", "correct the name")),
        ({"f": returns_too_many}, ("f fails at the prior", "ValueError", "declared sizes: 3 states")),
        ({"f": too_few_arguments}, ("f fails at the prior", "TypeError", "argument", "it takes (x, u, p, dt, out)")),
        ({"f": uses_python}, ("f cannot be compiled",)),
        ({"h": h_writes_too_far}, ("h of sensor s fails at the prior", "IndexError")),
        ({"Q": lopsided_Q}, ("Q is not symmetric",)),
        ({"Q": tiny_lopsided_Q}, ("Q is not symmetric",)),
    ],
    ids=lambda item: None if isinstance(item, tuple) else next(iter(item.values())).__name__,
)
def test_one_clear_line(changes, says):
    with pytest.raises(ModelError) as refused:
        compile_model(model(**changes))
    text = str(refused.value)
    assert "model curved: " in text
    assert "\n" not in text
    assert len(text) < 400
    for part in says:
        assert part in text
    # No trace of Numba's or NumPy's own error behind it.
    assert refused.value.__cause__ is None
    assert refused.value.__context__ is None or refused.value.__suppress_context__


def deeper(x, u, p, dt, out):
    out[0] = x[0]
    raises(x, u, p, dt, out)


@pytest.mark.parametrize(
    ("function", "culprit", "line"),
    [
        (raises, raises, 1),  # the line that fails, not the first one
        (deeper, raises, 1),  # in whatever function of the file it is
        (too_few_arguments, too_few_arguments, 0),  # it never begins
        (leaves_out, leaves_out, 0),
        (uses_python, uses_python, 2),  # as Numba says
    ],
)
def test_it_is_said_of_the_line_in_the_models_file(function, culprit, line, monkeypatch, tmp_path):
    code = culprit.__code__
    place = f"{code.co_filename}:{code.co_firstlineno + line}: model curved: f "
    monkeypatch.chdir(tmp_path)
    assert error_of(ModelError, compile_model, model(f=function)).startswith(place)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"states": ()}, "states is empty"),
        ({"sensors": ()}, "sensors is empty"),
        ({"states": (State("a", "1"), State("a", "1"))}, "names 'a' twice"),
        ({"states": (State("a", "1", std=-0.1),)}, "prior of a"),
        ({"states": (State("a", "1", mean=np.nan),)}, "prior of a"),
        ({"noises": (Noise("a", "1", -0.1),)}, "variance -0.1"),
        ({"noises": (Noise("elsewhere", "1", 0.1),)}, "'elsewhere' is not a state"),
        ({"max_step": 0.0}, "max_step is 0.0 s"),
        ({"parameters": (Parameter("c", "1", 1.0, 2.0, 0.5),)}, "parameter c ranges from 2 to 0.5"),
        ({"sensors": (Sensor("s", (), wrong_H),)}, "sensor s has no rows"),
        ({"sensors": (Sensor("s", (Row("r", "1", 1.0), Row("r", "1", 1.0)), wrong_H),)}, "sensor s names a row twice"),
    ],
)
def test_declarations_that_no_filter_could_run(changes, says):
    text = error_of(ModelError, model, **changes)
    assert "model curved: " in text and says in text


def test_compiled_functions_say_what_the_plain_ones_say():
    compiled = compile_model(model())
    x = np.array([0.2, -0.4, 1.9])
    fast, plain = np.empty(3), np.empty(3)
    compiled.f(x, U, P, 0.3, fast)
    f(x, U, P, 0.3, plain)
    # The same operations; the compiler may call another exp or fuse a multiply-add: two units in the last place.
    np.testing.assert_allclose(fast, plain, rtol=4e-16 * 4)
    fast, plain = np.empty(2), np.empty(2)
    compiled.h[0](x, U, P, fast)
    h(x, U, P, plain)
    np.testing.assert_allclose(fast, plain, rtol=4e-16 * 4)
    out = np.zeros((3, 3))
    compiled.Q(x, U, P, np.array([0.1]), 0.5, out)
    np.testing.assert_array_equal(out, np.diag([0.05, 0.0, 0.0]))


def test_a_model_is_compiled_once():
    assert compile_model(model()) is compile_model(model())


def turns_x(x, u, p, out):
    x[0] = -x[0]
    out[0] = x[0]


def scales_u(x, u, p, out):
    u[0] *= 2.0
    out[0] = x[0] + u[0]


def f_scales_u(x, u, p, dt, out):
    u[0] *= 2.0
    out[0] = x[0] + u[0]


def f_turns_x(x, u, p, dt, out):
    x[0] = -x[0]
    out[0] = -x[0]


def only_far(x, u, p, dt, out):
    out[0] = x[0]
    if x[0] > 0.01:
        x[0] = 1.0


def F_scales_x(x, u, p, dt, out):
    x[0] *= 2.0
    out[0, 0] = 1.0


def H_scales_x(x, u, p, out):
    x[0] *= 2.0
    out[0, 0] = 1.0


def Q_scales_x(x, u, p, q, dt, out):
    x[0] *= 2.0
    out[0, 0] = q[0] * dt


def Q_scales_q(x, u, p, q, dt, out):
    q[0] *= 2.0
    out[0, 0] = q[0] * dt


def likelihood_scales_x(y, x, u, p, r):
    x[0] *= 2.0
    return -0.5 * (y[0] - x[0]) ** 2 / r[0]


def likelihood_centres_y(y, x, u, p, r):
    y[0] -= x[0]
    return -0.5 * y[0] ** 2 / r[0]


def walk(sensor=(), **changes):
    """A state whose prior mean is zero, as are its input and the reading that it expects."""
    parts = dict(
        name="walk", title="", states=(State("s", "m", 0.0, 0.5),), noises=(Noise("s", "m²/s", 0.3),), f=unchanged,
        inputs=(Input("v", "m/s"),),
        sensors=(Sensor("y", (Row("y", "m", 0.04),), **({"h": first_state} | dict(sensor))),),
    )  # fmt: skip
    return StateSpaceModel(**(parts | changes))


CALLS, DRAWS = itertools.count(), np.random.default_rng(0)


def counted(x, u, p, dt, out):
    out[0] = x[0] + next(CALLS)


def timed(x, u, p, out):
    out[0] = x[0] + time.perf_counter()


def drawn(x, u, p, dt, out):
    out[0, 0] = DRAWS.normal()


def drawn_Q(x, u, p, q, dt, out):
    out[0, 0] = DRAWS.uniform()


def shaken(x):
    return x + gauss(0.0, 1.0) if x > 1e6 else x


def drawn_far_away(x, u, p, dt, out):
    out[0] = shaken(x[0])


random = 0.5


def drawn_by_alias(x, u, p, out):
    out[0] = x[0] if x[0] < 1e6 else other.gauss(random, 1.0)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"f": counted}, "f"),
        ({"f": drawn_far_away}, "f"),
        ({"sensor": {"h": drawn_by_alias}}, "h of sensor y"),
        ({"sensor": {"h": timed}}, "h of sensor y"),
        ({"F": drawn}, "F"),
        ({"Q": drawn_Q}, "Q"),
    ],
)
def test_what_is_no_function_of_its_arguments_is_refused(changes, what):
    with pytest.raises(ModelError, match=rf"test_compile_model.py:\d+: model walk: {what} returns another value for"):
        compile_model(walk(**changes))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"f": f_turns_x}, "f writes to its argument x"),
        ({"f": f_scales_u}, "f writes to its argument u"),
        ({"f": only_far}, "f writes to its argument x"),
        ({"F": F_scales_x}, "F writes to its argument x"),
        ({"Q": Q_scales_x}, "Q writes to its argument x"),
        ({"Q": Q_scales_q, "noises": (Noise("s", "m²/s", 0.0),)}, "Q writes to its argument q"),
        ({"sensor": {"h": turns_x}}, "h of sensor y writes to its argument x"),
        ({"sensor": {"h": scales_u}}, "h of sensor y writes to its argument u"),
        ({"sensor": {"H": H_scales_x}}, "H of sensor y writes to its argument x"),
        ({"sensor": {"log_likelihood": likelihood_scales_x}}, "log_likelihood of sensor y writes to its argument x"),
        ({"sensor": {"log_likelihood": likelihood_centres_y}}, "log_likelihood of sensor y writes to its argument y"),
    ],
    ids=lambda item: item.replace(" ", "_") if isinstance(item, str) else "",
)
def test_no_function_may_write_to_what_is_zero_at_the_prior(changes, says):
    compile_model(walk())
    with pytest.raises(ModelError, match=f"model walk: {says}, which is the filter's own; copy what it changes"):
        compile_model(walk(**changes))


def squares(x, u, p, dt, out):
    out[0] = x[0] * x[0]


def with_a_constant(x, u, p, dt, out):
    out[0] = 1e6 + 0.9 * (x[0] - 1e6) + dt * u[0]


def with_an_offset(x, u, p, out):
    out[0] = 273.15 + x[0]


@pytest.mark.parametrize("mean", (0.0, 1.0, 1e6))
@pytest.mark.parametrize("std", (1e-4, 1.0))
def test_what_is_said_to_be_linear_is_tried(mean, std):
    """A constant part is allowed: the filters call f and h themselves, and need their slopes to be constant."""
    states = (State("s", "m", mean, std),)
    compile_model(walk(states=states, linear=True))
    compile_model(walk(states=states, linear=True, f=with_a_constant, sensor={"h": with_an_offset}))
    for changes, what in (({"f": squares}, "f"), ({"sensor": {"h": first_state_squared}}, "h of sensor y")):
        compile_model(walk(states=states, **changes))
        with pytest.raises(ModelError, match=f"model walk: {what} is not linear, though the model says linear=True"):
            compile_model(walk(states=states, linear=True, **changes))
