"""The simulated asset: the article's very numbers, the same for a seed, losses that change nothing else."""

import numpy as np
import pytest

from estimators.errors import SourceError
from estimators.log import INPUT, READING, TICK, TRUTH, truth_of
from estimators.model.state_space import Input, Jump, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from sources.simulator import SensorPlan, Simulator, constant_input, factor, sine_input, stepped_input, summed_inputs
from tests.models import level_model, second_state
from tests.sources.can.can_tools import same
from tests.support import read_all

WINDING = MODELS["motor_winding"]


def article():
    """The article's draws, letter by letter: its true temperature and rate, and its measurement, or None if lost."""
    rng = np.random.default_rng(7)
    dt = 1.0
    F = np.array([[1.0, dt], [0.0, 1.0]])
    H = np.array([[1.0, 0.0]])
    Q = np.array([[0.01, 0.0], [0.0, 0.001]])
    R = np.array([[4.0]])
    x_true = np.array([40.0, 0.2])
    for k in range(120):
        x_true = F @ x_true + rng.multivariate_normal([0, 0], Q)
        y = H @ x_true + rng.normal(0, np.sqrt(R[0, 0]), size=1)
        yield x_true, None if k % 15 == 14 else y


def winding(**more):
    given = {"seed": 7, "step": 1.0, "duration": 120.0, "initial": {"temperature": 40.0, "rate": 0.2}, **more}
    return Simulator(WINDING, **given)


def test_the_articles_numbers():
    got = read_all(winding(sensors={"winding": SensorPlan(drop_every=15)}))
    assert (got.t[0], got.kind[0]) == (0, TICK)
    truth = got.value[got.kind == TRUTH]
    reading = got.value[got.kind == READING, 0]
    assert got.kind[1:].tolist() == [READING, TRUTH] * 120
    assert got.t[1:].tolist() == [10**9 * (k + 1) for k in range(120) for _ in range(2)]
    for k, (x, y) in enumerate(article()):
        np.testing.assert_allclose(truth[k], x, rtol=1e-14)  # a sum in another order
        assert np.isnan(reading[k]) if y is None else reading[k] == pytest.approx(y[0], rel=1e-14)


def test_a_seed_gives_one_run_and_losses_change_nothing_else():
    plain, lossy = read_all(winding()), read_all(winding(sensors={"winding": SensorPlan(drop_every=4)}))
    assert same(plain, read_all(winding())) and not same(plain, read_all(winding(seed=8)))
    lost = np.isnan(lossy.value[:, 0]) & (lossy.kind == READING)
    assert lost.sum() == 30 and same(plain.select(~lost), lossy.select(~lost))


def f(x, u, p, dt, out):
    out[0] = x[0] + dt * (p[0] * u[0] + u[1])
    out[1] = x[1] - dt * x[1] * x[1]


def both(x, u, p, out):
    out[0] = x[0] + u[0]
    out[1] = x[1]


def model(**more):
    given = {
        "name": "two",
        "title": "Two",
        "states": (State("a", "", 1.0, 1.0), State("b", "", 1.0, 1.0)),
        "noises": (Noise("a", "", 0.0), Noise("b", "", 0.0)),
        "inputs": (Input("u", "", 0.5), Input("v", "", 0.0)),
        "parameters": (Parameter("gain", "", 2.0),),
        "sensors": (
            Sensor("both", (Row("x", "", 1.0), Row("y", "", 1.0)), both),
            Sensor("one", (Row("one", "", 1.0),), second_state),
        ),
        "f": f,
        **more,
    }
    return StateSpaceModel(**given)


QUIET = {"both": SensorPlan(variances=(1e-30, 1e-30)), "one": SensorPlan(every=3, variances=(1e-30,), drop_every=2)}


def test_inputs_parameters_rates_and_losses():
    """Without noise every number follows by hand: u steps from 0.5 to 1 at 2 s, the true gain is 4."""
    source = Simulator(
        model(),
        seed=0,
        step=0.5,
        duration=6.0,
        truth_parameters={"gain": 4.0},
        inputs={"u": stepped_input((0.0, 2.0), (0.5, 1.0))},
        sensors=QUIET,
    )
    got = read_all(source)
    assert source.span == (0, 6 * 10**9) and not source.endless
    a, b, expected = 1.0, 1.0, []
    for k in range(12):
        a += 0.5 * 4.0 * (1.0 if 0.5 * k >= 2.0 else 0.5)
        b -= 0.5 * b * b
        u = 1.0 if 0.5 * (k + 1) >= 2.0 else 0.5
        expected.append((a + u, b))
    kinds = got.of_sensor(0)
    np.testing.assert_allclose(got.value[kinds, :2], expected, rtol=1e-12, atol=1e-12)
    once = got.of_sensor(1)
    assert got.t[once].tolist() == [1_500_000_000, 3_000_000_000, 4_500_000_000, 6_000_000_000]
    assert np.isnan(got.value[once, 0]).tolist() == [False, True, False, True]
    changes = got.t[(got.kind == INPUT) & (got.t > 0)]
    assert changes.tolist() == [2 * 10**9], "inputs are said when they change, at the time from which they hold"


@pytest.mark.parametrize(("truth", "pieces"), [({}, 5), ({"truth_model": model(max_step=0.2)}, 3)])
def test_long_steps_are_split_into_equal_pieces_as_the_asset_asks(truth, pieces):
    """The asset is the model of the estimator, of at most 0.1 s, or a truth of its own."""
    source = Simulator(model(max_step=0.1), seed=0, step=0.5, duration=0.5, sensors=QUIET, **truth)
    b = 1.0
    for _ in range(pieces):
        b -= 0.5 / pieces * b * b
    assert read_all(source).value[-1, 1] == pytest.approx(b, rel=1e-12)


def test_another_truth():
    def slower(x, u, p, dt, out):
        out[0] = x[0]
        out[1] = x[1] - 0.5 * dt

    source = Simulator(model(), seed=0, step=1.0, duration=2.0, truth_model=model(f=slower), sensors=QUIET)
    got = read_all(source)
    assert truth_of(got, 1)[1].tolist() == [0.5, 0.0]


def test_many_true_states_are_blocks():
    """60 states in blocks of 32: one that is full and one of 28; state j is j + t."""

    def grow(x, u, p, dt, out):
        for j in range(x.size):
            out[j] = x[j] + dt

    names = [f"s{j}" for j in range(60)]
    many = model(
        states=tuple(State(name, "", float(j), 1.0) for j, name in enumerate(names)),
        noises=(Noise("s0", "", 0.0),),
        sensors=(Sensor("one", (Row("one", "", 1.0),), second_state),),
        f=grow,
    )
    assert many.width == 32
    got = read_all(Simulator(many, seed=0, step=0.5, duration=1.0))
    truth = got.select(got.kind == TRUTH)
    assert truth.channel.tolist() == [0, 32] * 2
    assert truth.t.tolist() == [500_000_000] * 2 + [10**9] * 2
    assert np.isfinite(truth.value).sum(axis=1).tolist() == [32, 28] * 2
    for j in range(60):
        rows, values = truth_of(got, j)
        np.testing.assert_allclose(values, j + got.t[rows] * 1e-9, rtol=1e-14, atol=1e-12)
        assert rows.size == 2


def test_true_noise_has_its_variance():
    """10,000 increments: the estimated variance is within 5 standard errors, sqrt(2/n)."""
    got = read_all(winding(duration=10_000.0, truth_noise={"temperature": 0.25, "rate": 0.0}))
    x = got.value[got.kind == TRUTH]
    steps = np.diff(x[:, 0]) - x[:-1, 1]
    assert np.var(steps) == pytest.approx(0.25, rel=5 * np.sqrt(2 / steps.size))
    assert np.all(x[:, 1] == 0.2)


def test_profiles():
    stepped = stepped_input((0.0, 2.0, 5.0), (1.0, 2.0, 3.0), repeat=10.0)
    assert [stepped(t) for t in (-0.0, 1.9, 2.0, 4.9, 5.0, 9.9, 10.0, 12.5)] == [1, 1, 2, 2, 3, 3, 1, 2]
    assert stepped_input((1.0,), (4.0,))(0.0) == 4.0
    sine = sine_input(mean=1.0, amplitude=2.0, period=4.0, phase=np.pi / 2)
    assert [sine(t) for t in (0.0, 1.0, 2.0)] == pytest.approx([3.0, 1.0, -1.0])
    assert summed_inputs((constant_input(1.5), stepped, sine))(2.0) == pytest.approx(1.5 + 2.0 - 1.0)


def test_what_is_out_of_range_is_refused():
    with pytest.raises(SourceError, match="step is 0"):
        winding(step=0.0)
    with pytest.raises(SourceError, match="duration is -1"):
        winding(duration=-1.0)


def unmoved(x, u, p, dt, out):
    for j in range(x.size):
        out[j] = x[j]


def true_states(source):
    got = read_all(source)
    return np.array([truth_of(got, j)[1] for j in range(2)]).T


def test_noise_that_is_correlated_and_depends_on_the_state_has_its_covariance():
    """Steps of half a second, x' = x/2 + w, whose Q = C dt doubles where x[0] is positive.

    A product of two normals has the variance C_ii C_jj + C_ij²; the mean of n is right to 5 of its standard errors.
    """
    C = np.array([[4.0, 1.5], [1.5, 1.0]])

    def halve(x, u, p, dt, out):
        out[0] = 0.5 * x[0]
        out[1] = 0.5 * x[1]

    def Q(x, u, p, q, dt, out):
        scale = dt * (2.0 if x[0] > 0.0 else 1.0)
        out[0, 0], out[0, 1], out[1, 0], out[1, 1] = 4.0 * scale, 1.5 * scale, 1.5 * scale, scale

    x = true_states(Simulator(model(f=halve, Q=Q), seed=1, step=0.5, duration=4000.5))
    at, steps = x[:-1], x[1:] - 0.5 * x[:-1]
    up = at[:, 0] > 0
    assert min(up.sum(), (~up).sum()) > 3000
    for here, share in ((up, 1.0), (~up, 0.5)):
        found = steps[here].T @ steps[here] / here.sum()
        error = np.sqrt((np.outer(np.diag(C), np.diag(C)) + C**2) / here.sum()) * share
        assert np.all(np.abs(found - share * C) < 5 * error)


@pytest.mark.parametrize("rank", range(6))
def test_the_factor_of_a_covariance_has_its_rank_and_its_product(rank):
    rng = np.random.default_rng(rank)
    A = np.round(rng.normal(size=(5, rank)), 2) * [[1e-6], [1.0], [1e3], [1.0], [1e-3]]
    Q = A @ A.T
    L = factor(Q)
    np.testing.assert_allclose(L @ L.T, Q, rtol=0, atol=1e-13 * np.sqrt(np.outer(np.diag(Q), np.diag(Q))).max())
    assert np.sum(np.any(L != 0.0, axis=0)) == rank


def test_the_factor_of_a_covariance_has_the_same_bits_on_each_processor():
    """The largest entry is the first pivot. Two states that move against each other share one column; LAPACK gave a
    second one of 1e-9, by rounding that differed from processor to processor.
    """
    np.testing.assert_array_equal(factor(np.array([[1.0, -1.0], [-1.0, 1.0]])), [[1.0, 0.0], [-1.0, 0.0]])
    np.testing.assert_array_equal(factor(np.array([[4.0, 2.0], [2.0, 16.0]])), [[0.5, np.sqrt(3.75)], [4.0, 0.0]])
    np.testing.assert_array_equal(factor(np.diag([4.0, 0.0, 9.0])), [[0.0, 2.0, 0.0], [0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])


def test_a_true_angle_stays_within_a_turn():
    def turn(x, u, p, dt, out):
        out[0] = x[0] + 2.0 * dt
        out[1] = x[1]

    states = (State("a", "rad", 1.0, 1.0, circular=True), State("b", "", 1.0, 1.0))
    compass = model(f=turn, states=states, sensors=(Sensor("one", (Row("one", "", 1.0),), second_state),))
    x = true_states(Simulator(compass, seed=0, step=1.0, duration=50.0))[:, 0]
    assert np.all((x >= -np.pi) & (x < np.pi))
    np.testing.assert_allclose(np.exp(1j * x), np.exp(1j * (1.0 + 2.0 * np.arange(1, 51))), atol=1e-13)


def test_the_mode_jumps_as_the_model_says_in_each_piece():
    """From each of three modes surely to the next, four times a step: one onwards."""

    def onwards(x, u, p, dt, out):
        for j in range(3):
            out[j] = 0.0
        mode = int(x[1])
        out[(mode + 1) % 3] = 4.0 * dt
        out[mode] = 1.0 - 4.0 * dt

    states = (State("a", "", 1.0, 1.0), State("b", "", 1.0, 1.0))
    jumping = model(f=unmoved, states=states, noises=(Noise("a", "", 0.0),), max_step=0.25,
                    jump=Jump("b", ("x", "y", "z"), onwards))  # fmt: skip
    mode = true_states(Simulator(jumping, seed=0, step=1.0, duration=6.0, initial={"b": 0.0}))[:, 1]
    assert mode.tolist() == [1, 2, 0, 1, 2, 0]


def test_steps_that_are_no_binary_fraction_are_at_their_nanosecond():
    """3 · 0.3 is 0.8999…, and 2.7 / 0.3 is 8.99…: neither loses what it falls short of."""
    source = Simulator(model(), seed=0, step=0.3, duration=2.7, sensors=QUIET)
    got = read_all(source)
    assert np.unique(got.t).tolist() == [k * 300_000_000 for k in range(10)]
    assert source.span == (0, 2_700_000_000)


def raises_above_one(x, u, p, dt, out):
    if x[0] > 1.0:
        raise ValueError("too high")
    out[0] = x[0] + dt


def test_a_model_that_raises_on_the_way_is_one_line():
    model = level_model({"s": 1.0}, 0.0, name="rising", f=raises_above_one)
    source = Simulator(model, seed=1, step=0.5, duration=10.0)
    with pytest.raises(
        SourceError, match=r"model rising fails at 2 s: ValueError: too high; it may not fail at states"
    ):
        read_all(source)
