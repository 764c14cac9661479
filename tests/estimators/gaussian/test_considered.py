"""Schmidt's filter: what is considered keeps value and variance, and widens the covariance of what is estimated."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.diagnostics.considered_shares import considered_pairs, known_stds, noise_std, variance_shares
from estimators.errors import EstimatorError, ModelError
from estimators.fold import Fold
from estimators.log import READING, Events, Log
from estimators.model.assemble import JointParameter, joint
from estimators.model.instruments import Instrument, with_instruments
from estimators.model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from estimators.registry import ESTIMATORS, find_estimator
from estimators.smoothing.smooth import check_smooth
from estimators.tuning import Tuning
from tests.models import complex_step
from tests.support import SECOND, folded

CONSIDERING = [name for name, entry in ESTIMATORS.items() if entry.considers and entry.family == "Gaussian"]
CONSIDERED = {"offset": JointParameter(0.3, considered=True), "loss": JointParameter(0.02, considered=True)}
ESTIMATED = {"heat": JointParameter(0.5, drift=0.01)}
STEP = 0.5


def f(x, u, p, dt, out):
    loss, heat = p[1], p[2]
    out[0] = x[0] + dt * (u[0] * heat - loss - 0.1 * x[0] + 0.05 * x[1])
    out[1] = x[1] + dt * (0.05 * x[0] - 0.08 * x[1])


def bilinear(x, u, p, dt, out):
    loss, heat = p[1], p[2]
    out[0] = x[0] + dt * (u[0] * heat - loss * x[0] + 0.05 * x[1])
    out[1] = x[1] + dt * (0.05 * x[0] - 0.08 * x[1])


def first(x, u, p, out):
    out[0] = x[0] + p[0]


def both(x, u, p, out):
    out[0] = x[0] - x[1]
    out[1] = x[1] + 0.5 * p[0]


def physics(f):
    return StateSpaceModel(
        name="considering",
        title="two temperatures",
        states=(State("a", "K", mean=2.0, std=1.0), State("b", "K", mean=1.0, std=2.0)),
        noises=(Noise("a", "K²/s", variance=0.01), Noise("b", "K²/s", variance=0.02)),
        sensors=(
            Sensor("first", (Row("first", "K", variance=0.04),), h=first),
            Sensor("both", (Row("difference", "K", variance=0.09), Row("b", "K", variance=0.01)), h=both),
        ),
        f=f,
        inputs=(Input("power", "W", default=0.5),),
        parameters=(Parameter("offset", "K", 0.1), Parameter("loss", "1/s", 0.1), Parameter("heat", "K/J", 1.0)),
        linear=f is not bilinear,
    )


def log_of(steps=40):
    rng = np.random.default_rng(3)
    log = Log(2)
    for k in range(steps):
        channel = k % 2
        value = rng.normal(2.0, 0.5, channel + 1)
        if k == 11:
            value[0] = np.nan  # one row of two is missing
        t = int(k * STEP * SECOND)
        log.extend(Events.one(t, t, READING, channel, value, 2))
    return log


def schmidt(model, log, u, inflation=1.0):
    """Mean (nx,) and covariance after each event, by the equations in blocks, with NumPy and complex steps.

    `inflation` is the factor a second on the covariance of the estimated states, with the correlations unchanged.

    Source: Jazwinski (1970), Stochastic Processes and Filtering Theory, 8.4.
    """
    nc = model.considered
    n = model.nx - nc
    p = model.default_parameters
    z, C = model.prior_mean.copy(), model.prior_cov[n:, n:]
    Pxx, Pxc = np.diag(model.prior_std[:n] ** 2), np.zeros((n, nc))
    q = np.zeros(model.nx)
    for noise in model.noises:
        q[model.state_names.index(noise.name)] += noise.variance

    for k in range(log.n):
        if k > 0:

            def step(x, out):
                model.f(x, u, p, STEP, out)

            F = complex_step(step, z, model.nx)
            A, B = F[:n, :n], F[:n, n:]
            forward = np.empty(model.nx)
            step(z, forward)
            z = forward
            Pxx = A @ Pxx @ A.T + A @ Pxc @ B.T + B @ Pxc.T @ A.T + B @ C @ B.T
            Pxx = inflation**STEP * Pxx + STEP * np.diag(q[:n])
            Pxc = inflation ** (0.5 * STEP) * (A @ Pxc + B @ C)
        sensor = model.sensors[log.events.channel[k]]
        rows = len(sensor.rows)
        H = complex_step(lambda x, out, h=sensor.h: h(x, u, p, out), z, rows)
        expected = np.empty(rows)
        sensor.h(z, u, p, expected)
        nu = log.events.value[k, :rows] - expected
        seen = np.isfinite(nu)
        Hx, Hc, nu = H[seen, :n], H[seen, n:], nu[seen]
        R = np.diag([row.variance for row in sensor.rows])[np.ix_(seen, seen)]
        S = Hx @ Pxx @ Hx.T + Hx @ Pxc @ Hc.T + Hc @ Pxc.T @ Hx.T + Hc @ C @ Hc.T + R
        K = (Pxx @ Hx.T + Pxc @ Hc.T) @ np.linalg.inv(S)
        z[:n] += K @ nu
        Pxx = Pxx - K @ S @ K.T
        Pxc = Pxc - K @ (Hx @ Pxc + Hc @ C)
        yield z.copy(), np.block([[Pxx, Pxc], [Pxc.T, C]]), nu @ np.linalg.inv(S) @ nu


# Sigma points are exact where f and h are linear; elsewhere tangents are those of the equations.
@pytest.mark.parametrize(
    ("estimator", "f", "options"),
    [
        *((name, f, {}) for name in CONSIDERING),
        *((name, bilinear, {}) for name in ("ekf", "sr-ekf")),
        ("ekf", bilinear, {"joseph": "on"}),
        *((name, f, {"inflation": 1.5}) for name in ("kf", "ukf", "sr-ekf", "sr-ukf")),
    ],
)
def test_it_equals_the_equations_in_blocks(estimator, f, options):
    model = joint(physics(f), CONSIDERED | ESTIMATED)
    assert model.state_names == ("a", "b", "heat", "offset_deviation", "loss_deviation") and model.considered == 2
    equal_to_the_equations(estimator, model, options)


def equal_to_the_equations(estimator, model, options, written=None):
    log = log_of()
    fold = Fold(estimator, model, Tuning.of(model).with_options(options), log)
    inflation = options.get("inflation", 1.0)
    for mean, cov, nis in schmidt(written or model, log, model.default_inputs, inflation):
        fold.advance(1)
        actual, P = fold.moments()
        np.testing.assert_allclose(actual, mean, rtol=0, atol=1e-9 * np.max(np.abs(mean)))
        np.testing.assert_allclose(P, cov, rtol=0, atol=1e-9 * np.max(np.abs(cov)))
        assert fold.track.nis[fold.n - 1] == pytest.approx(nis, rel=1e-8)


# Two correlated deviations of a fit, and parameters that widen with a state and an input outside their ranges.
FITTED = {
    "offset": JointParameter(0.3, considered=True),
    "loss": JointParameter(0.02, considered=True, widened={"a": 0.05, "power": 0.4}),
    "heat": JointParameter(0.0, considered=True, widened={"power": 0.7}),
}


def ranged():
    """The model, fitted for a below 1.9 K and powers below 0.25 W: the default of 0.5 W lies outside."""
    model = physics(f)
    states = (replace(model.states[0], fitted=(-np.inf, 1.9)), model.states[1])
    return replace(model, states=states, inputs=(replace(model.inputs[0], fitted=(0.0, 0.25)),))


def by_hand(model):
    """The same with p + δ + η Σ w d written out, on states (a, b, [heat,] δ_offset, δ_loss, η_loss, η_heat)."""

    def effective(x, u, p):
        a, b = np.maximum(0.0, x[0].real - 1.9), np.maximum(0.0, u[0] - 0.25)
        d_offset, d_loss, loss, heat = x[-4:]
        return [p[0] + d_offset, p[1] + d_loss + (0.05 * a + 0.4 * b) * loss, (*p, x[2])[2] + 0.7 * b * heat]

    def forward(x, u, p, dt, out):
        f(x, u, effective(x, u, p), dt, out)
        out[2:] = x[2:]

    sensors = tuple(
        replace(sensor, h=lambda x, u, p, out, h=sensor.h: h(x, u, effective(x, u, p), out))
        for sensor in physics(f).sensors
    )
    return replace(model, f=forward, sensors=sensors)


@pytest.mark.parametrize("estimator", ["ekf", "sr-ekf"])
@pytest.mark.parametrize("moved", [(), ("heat",)], ids=["considered", "estimated"])
def test_correlated_and_widened_parameters_equal_the_equations_in_blocks(estimator, moved):
    heat = {name: JointParameter(1.0, widened={"power": 0.7}) for name in moved}
    model = joint(ranged(), FITTED | heat, {("loss", "offset"): -0.8})
    assert model.state_names[2:] == (*moved, "offset_deviation", "loss_deviation", "loss_outside", "heat_outside")
    assert model.prior_cov[-4, -3] == pytest.approx(-0.8 * 0.3 * 0.02)
    equal_to_the_equations(estimator, model, {}, by_hand(model))


@pytest.mark.parametrize(
    ("estimated", "correlations", "rule"),
    [
        (FITTED, {("offset", "heat"): 0.1}, "heat is not; give it a std"),
        (FITTED | {"heat": JointParameter(1.0, considered=True)},
         {("offset", "heat"): 0.9, ("offset", "loss"): 0.9, ("heat", "loss"): -0.9}, "contradict each other"),
        ({"loss": JointParameter(0.0, considered=True, widened={"b": 1.0})}, {}, "range of b, which has none"),
        ({"loss": JointParameter(0.0, considered=True, widened={"c": 1.0})}, {}, "no state or input 'c'"),
    ],
)  # fmt: skip
def test_impossible_widths_are_refused(estimated, correlations, rule):
    with pytest.raises(ModelError, match=rule):
        joint(ranged(), estimated, correlations)


@pytest.mark.parametrize("estimator", ["ekf", "sr-ukf"])
@pytest.mark.parametrize("options", [{"adapt": "Q"}, {"adapt": "R"}, {"robust": "huber"}, {"inflation": 2.0}])
def test_options_leave_what_is_considered(estimator, options):
    model = joint(physics(f), CONSIDERED)
    fold = folded(estimator, model, log_of(), options=options)
    mean, P = fold.moments()
    np.testing.assert_allclose(mean[2:], 0.0, atol=1e-13)  # sigma points leave rounding errors
    np.testing.assert_allclose(P[2:, 2:], np.diag([0.3**2, 0.02**2]), rtol=1e-9, atol=1e-12)


def driven_by_hand(x, u, p, dt, out):
    power = p[5] * u[0] + p[6]
    out[0] = x[0] + dt * (power * p[2] - p[1] * x[0] + 0.05 * x[1])
    out[1] = x[1] + dt * (0.05 * x[0] - 0.08 * x[1])


def both_by_hand(x, u, p, out):
    out[0] = p[3] * (x[0] - x[1]) + p[7]
    out[1] = p[4] * (x[1] + 0.5 * p[0]) + p[8]


def test_offsets_and_scales_equal_a_model_that_has_them():
    own = physics(bilinear)
    made = with_instruments(own, {"power": Instrument((0.0,), (1.0,)), "both": Instrument((0.05, 0.02), (1.0, 0.9))})
    names = ["power_scale", "power_offset", "both_difference_scale", "both_b_scale"]
    names += ["both_difference_offset", "both_b_offset"]
    assert [item.name for item in made.parameters[3:]] == names
    order = ["both_difference_scale", "both_b_scale", "power_scale", "power_offset", "both_difference_offset"]
    by_name = {item.name: item for item in made.parameters}
    by_hand = replace(
        own,
        f=driven_by_hand,
        sensors=(own.sensors[0], replace(own.sensors[1], h=both_by_hand)),
        parameters=(*own.parameters, *(by_name[name] for name in [*order, "both_b_offset"])),
    )
    widths = {name: JointParameter(0.02 * (k + 1), considered=True) for k, name in enumerate(names)}
    folds = [Fold("ekf", joint(model, widths), Tuning.of(joint(model, widths)), log_of()) for model in (made, by_hand)]
    for fold in folds:
        fold.advance()
    place = [folds[1].model.state_names.index(name) for name in folds[0].model.state_names]
    (mean, P), (expected, Q) = folds[0].moments(), folds[1].moments()
    np.testing.assert_allclose(mean, expected[place], rtol=1e-12)
    np.testing.assert_allclose(P, Q[np.ix_(place, place)], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize(("given", "kind", "linear"), [("power", "offset", True), ("first", "scale", False)])
def test_offsets_keep_a_model_linear_and_scales_do_not(given, kind, linear):
    own = with_instruments(physics(f), {given: Instrument(**{kind: (0.0 if kind == "offset" else 1.0,)})})
    model = joint(own, {f"{given}_{kind}": JointParameter(0.05, considered=True)})
    assert model.linear == linear
    if linear:
        assert find_estimator("kf", model).name == "kf"
    else:
        with pytest.raises(EstimatorError, match=f"not linear once {given}_{kind}_deviation .* use .*: ekf, ukf"):
            find_estimator("kf", model)


def simulated(physics, p, steps=40):
    """A log without noise of an asset with parameters p from the prior's mean on, and its last state."""
    log, x, u = log_of(steps), physics.prior_mean.copy(), physics.default_inputs
    for k in range(steps):
        if k > 0:
            forward = np.empty(2)
            physics.f(x, u, p, STEP, forward)
            x = forward
        out = np.empty(1 + k % 2)
        physics.sensors[k % 2].h(x, u, p, out)
        log.events.value[k, : out.size] = np.where(np.isnan(log.events.value[k, : out.size]), np.nan, out)
    return log, x


@pytest.mark.parametrize("estimator", ["ekf", "sr-ekf"])
def test_shares_of_the_variance_are_those_of_refolds(estimator):
    """The error of a fold changes with the asset's parameters by the sensitivity that the shares are made of."""
    own = physics(f)
    model = joint(own, CONSIDERED)
    errors = []
    for moved in ({}, {0: 0.3}, {1: 0.02}):
        p = own.default_parameters + np.array([moved.get(k, 0.0) for k in range(3)])
        log, truth = simulated(own, p)
        pairs = np.concatenate(([[0, 1]], considered_pairs(model)))
        fold = folded(estimator, model, log, pairs=pairs)
        mean, P = fold.moments()
        errors.append(truth - mean[:2])
    shares = variance_shares(model, P)
    for i, name in enumerate(own.state_names):
        offset, loss = ((error[i] - errors[0][i]) ** 2 / P[i, i] for error in errors[1:])
        assert shares[name] == pytest.approx({"offset": offset, "loss": loss, "noise": 1.0 - offset - loss}, abs=1e-8)
        assert list(shares[name])[0] == max(("offset", offset), ("loss", loss), key=lambda item: item[1])[0]
        noise = noise_std(model, i, fold.track.std, fold.track.cross)
        assert noise[-1] == pytest.approx(np.sqrt(P[i, i] * (1.0 - offset - loss)), rel=1e-7)
        assert np.isnan(noise_std(model, i, fold.track.std, fold.track.cross[:, :1])).all()
    correlated = joint(own, CONSIDERED, {("offset", "loss"): 0.9})
    fold = folded(estimator, correlated, log)
    P = fold.moments()[1]
    assert sum(variance_shares(correlated, P)["a"].values()) == pytest.approx(1.0)
    known = known_stds(correlated, P)
    for j, name in ((2, "offset"), (3, "loss")):
        rest = np.delete(np.arange(4), j)
        # Conditioned on it by a measurement almost without noise, in information form.
        information = np.linalg.inv(P) + np.diag(np.eye(4)[j]) * 1e9 / P[j, j]
        left = np.sqrt(np.diag(np.linalg.inv(information)))[rest[:2]]
        assert [known[state][name] for state in ("a", "b")] == pytest.approx(left.tolist(), rel=1e-6)


def test_a_smoother_refuses_what_is_considered():
    model = joint(physics(f), CONSIDERED)
    with pytest.raises(EstimatorError, match="considers offset_deviation, loss_deviation.*role: held"):
        check_smooth(find_estimator("ekf", model), model, {})


# Of N members the mean scatters by σ/√N and a covariance by √2 σσ/√N; of weighted particles N is the smallest effective
# sample size so far. That of apf and pf-ekf is of the weights left after their draws, which keep no more distinct
# values of a and b than those of pf do, whose smallest effective size is N/20 here.
@pytest.mark.parametrize(
    ("estimator", "options", "share"),
    [
        *((name, {"members": 4000.0}, 1.0) for name in ("enkf", "etkf", "ensrf", "letkf")),
        *((name, {"particles": 40000.0}, 0.05) for name in ("apf", "pf-ekf")),
        ("pf", {"particles": 40000.0}, np.inf),
        ("rbpf", {"particles": 10000.0}, np.inf),
        ("pf-reg", {"bandwidth": 2.0, "particles": 40000.0}, np.inf),
    ],
)
def test_members_have_the_moments_of_the_equations(estimator, options, share):
    own = replace(physics(f), conditionally_linear=("a", "b"))
    model = joint(own, CONSIDERED)
    log, _ = simulated(own, own.default_parameters)
    noise = np.random.default_rng(1).standard_normal((log.n, 2))
    for k in range(log.n):
        rows = own.sensors[k % 2].rows
        log.events.value[k, : len(rows)] += noise[k, : len(rows)] * np.sqrt([row.variance for row in rows])
    fold = Fold(estimator, model, Tuning.of(model).with_options(options), log)
    count = share * options.get("members", options.get("particles"))
    for k, (mean, cov, _) in enumerate(schmidt(model, log, model.default_inputs)):
        fold.advance(1)
        count = np.fmin(count, fold.track.effective[k])
        std = np.sqrt(np.diag(cov))
        actual, P = fold.moments()
        assert np.max(np.abs(actual - mean) / std) < 5.0 / np.sqrt(count)
        assert np.max(np.abs(P - cov) / np.outer(std, std)) < 5.0 * np.sqrt(2.0 / count)
