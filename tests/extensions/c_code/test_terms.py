"""Formulas read from functions, against the functions themselves on numbers, and their derivatives by complex step."""

import math

import numpy as np
import pytest

from app.extensions.c_code.terms import FUNCTIONS, Reader, Statements, Term
from estimators.errors import ModelError
from estimators.numerics.jit import jit
from tests.support import error_of

NODES = np.array([0.0, 1.0, 2.5, 4.0])
VALUES = np.array([0.3, -1.0, 0.5, 2.0])


@jit
def interpolated(z):
    """A table of lines, whose node depends on the state."""
    k = 0
    while k < NODES.size - 2 and z.real > NODES[k + 1]:
        k += 1
    share = (z - NODES[k]) / (NODES[k + 1] - NODES[k])
    return VALUES[k] + share * (VALUES[k + 1] - VALUES[k])


def table(x, u, p, out):
    """A helper, a branch, and a loop over states."""
    out[0] = interpolated(x[0]) if u[0] > 0.0 else p[0] * x[0] ** 3
    for i in range(x.size):
        out[1] += np.sqrt(1.0 + x[i] * x[i])


def functions(x, u, p, out):
    """Functions of NumPy, of scalars and of arrays."""
    out[0] = np.sin(x[0]) * np.exp(-x[1]) + np.tanh(x[0] / p[0])
    out[1] = np.sum(np.array([np.log(2.0 + x[1] ** 2), np.cos(u[0] * x[0])])) + (x[0] + 7.0) ** 2.5 + 2.0 ** p[0]


def limits(x, u, p, out):
    """Builtins that compare, and the mathematics of Python, which knows no complex numbers."""
    out[0] = max(-0.5, min(x[0], 0.5)) + abs(x[1])
    out[1] = math.floor(p[0]) + x[1] % 2.0 + math.atan2(1.5, 2.0)


@jit
def clipped(z):
    """A helper with two branches, which end with its call."""
    if z.real < -0.2:
        return -0.2
    return 0.8 if z.real > 0.8 else z


def clip(x, u, p, out):
    """Twenty calls of a helper with branches: two to the twentieth ways, if they did not end there."""
    for k in range(20):
        out[k % 2] += clipped(x[k % 2] - 0.1 * k + p[0])


def value(term, known):
    """The value of a term, where `known` has those of the symbols."""
    if term.operation == "symbol":
        return known[term.of[0]]
    if term.operation == "constant":
        return term.of[0]
    if term.operation == "?":
        return value(term.of[1] if value(term.of[0], known) else term.of[2], known)
    of = [value(item, known) for item in term.of]
    if term.operation in FUNCTIONS:
        return getattr(math, term.operation)(*of)
    return eval(f"a {term.operation} b", {"a": of[0], "b": of[1]})


def symbols(reader):
    return reader.symbols("x", 2), reader.symbols("u", 1), reader.symbols("p", 1)


@pytest.mark.parametrize("function", [table, functions, limits, clip])
def test_formulas_equal_the_function_and_their_derivatives_complex_step(function):
    reader = Reader()
    x, u, p = symbols(reader)
    terms = reader.read(function, (x, u, p), (2,))
    slopes = reader.jacobian(terms, x)
    rng = np.random.default_rng(1)
    for _ in range(40):
        at, drive, parameter = rng.uniform(-0.4, 3.9, 2), rng.uniform(-1.0, 1.0, 1), rng.uniform(1.0, 2.0, 1)
        known = {"x[0]": at[0], "x[1]": at[1], "u[0]": drive[0], "p[0]": parameter[0]}
        expected = np.zeros(2)
        getattr(function, "py_func", function)(at, drive, parameter, expected)
        np.testing.assert_allclose([value(item, known) for item in terms], expected, rtol=1e-14)
        if function is limits:
            expected = [[float(-0.5 < at[0] < 0.5), np.sign(at[1])], [0.0, 1.0]]
            np.testing.assert_array_equal([[value(item, known) for item in row] for row in slopes], expected)
            continue
        for j in range(2):
            step = at.astype(complex)
            step[j] += 1e-30j
            out = np.zeros(2, complex)
            function(step, drive, parameter, out)
            found = [value(item, known) for item in slopes[:, j]]
            np.testing.assert_allclose(found, out.imag / 1e-30, rtol=1e-13, atol=1e-15)


def test_equal_operations_are_computed_once():
    reader = Reader()
    x = reader.symbols("x", 1)

    def f(x, out):
        out[0] = np.sin(x[0] + 1.0) * 1.0 + 0.0
        out[1] = np.sin(x[0] + 1.0) + np.sin(1.0 + 0.0 * x[0])

    found = Statements([(f"out[{k}]", item) for k, item in enumerate(reader.read(f, (x,), (2,)))])
    assert sorted(found.operations) == ["+", "+", "sin"]
    assert found.lines[0] == "const real t0 = sin((x[0] + R(1.0)));"


def endless(x, u, p, out):
    """A loop that depends on the state."""
    out[0] = x[0]
    while out[0] > 0.1:
        out[0] = 0.5 * out[0]


def many(x, u, p, out):
    """Ten independent branches."""
    for k in range(10):
        out[0] += x[0] if x[1] > k + u[0] else x[1]


def index(x, u, p, out):
    """A state as an index."""
    out[0] = VALUES[int(x[0])]


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (endless, "endless compares more than 64 times: a loop depends on the state"),
        (many, "many has more than 512 ways through its comparisons"),
        (index, "index turns a state, an input or a parameter into a plain number, by float() or as an index"),
    ],
)
def test_a_function_that_cannot_be_read_says_why(function, message):
    reader = Reader()
    assert error_of(ModelError, reader.read, function, symbols(reader), (2,)) == message


def test_a_term_is_no_number():
    with pytest.raises(ModelError, match="plain number"):
        float(Term(Reader(), "symbol", ("x[0]",)))
