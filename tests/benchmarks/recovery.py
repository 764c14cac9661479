"""`python -m tests.benchmarks.recovery`: are the values that made simulated logs found again, in their 95 % intervals?

Each twin's simulator is given other noises and parameters than its YAML believes, and an initial state drawn from the
prior. Every log is fitted from what the YAML says, and counts whether each true value lies in its interval; an entry
that a fit leaves alone has none, and is counted apart. With the next log's readings, to which it was not fitted, the
fitted tuning must have its NIS and coverage in their bounds.

What is fitted is itself uncertain. Under the values that made the logs the mean NIS m of another log has the variance V
of its chi-square; under fitted values θ̂, which are off by N(0, C), it is off by gᵀ (θ̂ - θ) too, g = ∂m/∂θ. So

    var m = V + gᵀ C g

with C the covariance that the fit gives its estimates, and g by differences on that other log. Where one scale of all
noises is fitted to a log as long as the other, the two parts are equal, and bounds that forget the second, each as wide
as it should be for V alone, are left by 7 % of the logs in place of 1 %: what was counted here at first.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from time import process_time

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from scipy.optimize import minimize

from app.twin.log_reader import read_log
from app.twin.twin import Twin, load_twin
from estimators.diagnostics.score import score
from estimators.fit.entries import TuningEntry, entries_of, with_values
from estimators.fit.fit import Fitted, fit
from estimators.fit.recording import Recording
from estimators.log import INPUT, READING, Log
from estimators.track import USED
from tests.support import folded

from .timing import BenchmarkRow, Bound, both

Z, Z99 = 1.959963984540054, 2.5758293035489004


@dataclass(frozen=True)
class Case:
    """A twin, how its simulator differs from what the YAML believes, and what is fitted.

    `truth` has the true values by key; `more` are further overrides of the YAML.
    """

    twin: str
    estimator: str
    truth: Mapping[str, float]
    duration: float
    more: Mapping[str, str] = field(default_factory=dict)
    rows: Mapping[str, int] = field(default_factory=dict)

    def overrides(self, seed: int) -> dict[str, str]:
        """Of the YAML."""
        noise = {key[2:]: {"variance": value} for key, value in self.truth.items() if key.startswith("Q.")}
        parameters = {key[2:]: value for key, value in self.truth.items() if key.startswith("p.")}
        sensors = {key[2:]: float(np.sqrt(value)) for key, value in self.truth.items() if key.startswith("R.")}
        found = {
            **self.more,
            "estimator": json.dumps(self.estimator),
            "source.seed": str(1000 + seed),
            "source.duration": str(self.duration),
            "source.truth.noise": json.dumps(noise),
        }
        if parameters:
            found["source.truth.parameters"] = json.dumps(parameters)
        return found | {f"source.sensors.{name}.std": str(std) for name, std in sensors.items()}


CASES = (
    Case(
        "motor_winding",
        "kf",
        {"Q.temperature": 0.2, "Q.rate": 3e-4, "R.winding": 2.0},
        1500.0,
    ),
    Case(
        "motor_joint",
        "ukf",
        {
            "Q.winding": 0.02, "Q.tooth": 0.004, "Q.yoke": 0.003, "Q.magnet": 0.004,
            "R.winding": 0.1, "R.tooth": 0.4, "R.yoke": 0.15,
            "p.copper_resistance": 0.0115, "p.yoke_coolant": 0.036,
        },
        900.0,
        {"parameters": "{}", "source.initial": "{}", "view.pairs": "[[winding, magnet]]"},
    ),
    Case(
        "lorenz63",
        "ekf",
        {"Q.x": 0.4, "Q.y": 0.9, "Q.z": 0.5, "R.position": 1.0, "p.sigma": 9.6, "p.rho": 28.4, "p.beta": 2.72},
        60.0,
        {"source.sensors": "{position: {every: 1}}", "noise": json.dumps({name: {"variance": 0.2} for name in "xyz"})},
    ),
    Case(
        "battery_pack",
        "ekf",
        {
            "Q.v1": 4e-6, "Q.temperature": 4e-4, "R.voltage": 2e-5, "R.temperature": 0.04,
            "p.r0_5": 0.046, "p.r0_1": 0.033,
        },
        600.0,
        {"noise.soc": "{variance: 1e-9}"},
    ),
    Case(
        "lorenz96",
        "ukf",
        {"Q.x": 0.02, "R.stations": 0.5, "p.forcing": 8.2},
        10.0,
        # Here all that is wrong is Q, R and the forcing: no inflation makes up for what is no noise, and the prior is
        # not the whole attractor. The unscented filter, since the extended one leaves out the mean of the products in
        # this model, which the forcing then makes up for.
        {"noise.x": "{variance: 0.01}", "filters": "{}", "prior.x": "{std: 0.5}"},
    ),
)  # fmt: skip


def logs_of(case: Case, count: int) -> tuple[Twin, list[Log]]:
    """The twin, and so many logs of its simulator, each from an initial state that is drawn from the prior."""
    twin = load_twin(case.twin, overrides=case.overrides(0))
    logs = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        model = twin.model
        initial = {
            name: float(value)
            for name, value in zip(model.state_names, rng.normal(model.prior_mean, model.prior_std), strict=True)
        }
        overrides = {**case.overrides(seed), "source.initial": json.dumps(initial)}
        logs.append(read_log(load_twin(case.twin, overrides=overrides), None)[0])
    return twin, logs


@dataclass
class Recovered:
    """Counts of one case: by key how often an interval held the truth, how often there was one, and its widths.

    `consistent` logs have their NIS in its 99 % bounds, `without` in those that forget that the tuning is estimated,
    which are `wider` by so much.
    """

    inside: dict[str, int] = field(default_factory=dict)
    told: dict[str, int] = field(default_factory=dict)
    width: dict[str, list[float]] = field(default_factory=dict)
    middle: dict[str, list[float]] = field(default_factory=dict)
    consistent: int = 0
    without: int = 0
    wider: list[float] = field(default_factory=list)
    coverage: list[float] = field(default_factory=list)
    folds: int = 0
    logs: int = 0

    def share(self) -> float:
        """Of all intervals, those that hold the truth."""
        return sum(self.inside.values()) / max(1, sum(self.told.values()))


def recover(case: Case, count: int) -> Recovered:
    """Fit every log, and look where the truth lies."""
    twin, logs = logs_of(case, count)
    found = Recovered(logs=count)
    for k, log in enumerate(logs):
        fitted = fit(twin.estimator, twin.tuning, [Recording(log)], wanted=list(case.truth), blocks=0)
        found.folds += fitted.folds
        for line in fitted.lines:
            truth = case.truth[line.key]
            if line.alone:
                continue
            found.told[line.key] = found.told.get(line.key, 0) + 1
            found.inside[line.key] = found.inside.get(line.key, 0) + (line.low <= truth <= line.high)
            found.width.setdefault(line.key, []).append(line.high / line.low)
            found.middle.setdefault(line.key, []).append(line.after)
        other = logs[(k + 1) % count]
        fold = folded(twin.estimator, twin.model, other, fitted.setting.tuning)
        result = score(fold.track, other.events, twin.model, gate=twin.tuning.gate)
        *_, low, high = result.nis_verdict
        off = abs(result.nis - 0.5 * (high + low))
        chance = 0.5 * (high - low) / Z
        spread = np.hypot(chance, of_the_fit(twin, fitted, other))
        # Bounds of 99 %: they are asked 50 times.
        found.consistent += off <= Z99 * spread
        found.without += off <= Z99 * chance
        found.wider.append(spread / chance)
        found.coverage.append(float(np.mean([item.coverage for item in result.states.values()])))
    return found


def of_the_fit(twin: Twin, fitted: Fitted, log: Log) -> float:
    """Standard deviation of the mean NIS of a log that is due to how sure the fit is: √(gᵀ C g)."""
    told = [i for i, line in enumerate(fitted.lines) if not line.alone]
    if not told:
        return 0.0
    tuning = fitted.setting.tuning
    entries, _ = entries_of(twin.estimator, tuning, [log], [fitted.lines[i].key for i in told])

    def nis(item: TuningEntry, by: float) -> float:
        given = with_values(tuning, [item], [item.outward(item.inward(item.start) + by)])
        fold = folded(twin.estimator, twin.model, log, given.tuning, prior=given.prior)
        return float(fold.track.nis[fold.track.verdict == USED].mean())

    # A difference over half a deviation: of the slope as wide as the estimate is uncertain.
    steps = [0.25 * fitted.lines[i].deviation for i in told]
    slopes = [nis(item, step) - nis(item, -step) for item, step in zip(entries, steps, strict=True)]
    g = np.array(slopes) / 0.5
    correlation = fitted.correlation[np.ix_(told, told)]
    return float(np.sqrt(max(0.0, g @ correlation @ g)))


def lines(case: Case, found: Recovered) -> list[str]:
    """What is printed of a case."""
    narrow = f"{found.without} in those of a known tuning, {np.median(found.wider):.2f} times as narrow"
    text = [
        f"{case.twin}, {case.estimator}: {found.logs} logs, {found.folds / found.logs:.0f} folds each; "
        f"{100 * found.share():.1f} % of the intervals hold the truth; on the next log NIS in its 99 % bounds "
        f"{found.consistent} of {found.logs} ({narrow}), "
        f"states in their 95 % band {100 * np.mean(found.coverage):.1f} %",
        f"  {'entry':22} {'truth':>10} {'median':>10} {'inside':>8} {'told':>5}  high/low",
    ]
    for key, truth in case.truth.items():
        if key in found.told:
            text.append(
                f"  {key:22} {truth:10.4g} {np.median(found.middle[key]):10.4g} "
                f"{found.inside[key]:4d}/{found.told[key]:<3d} {found.told[key]:5d}  {np.median(found.width[key]):.3g}"
            )
        else:
            text.append(f"  {key:22} {truth:10.4g} {'':>10} {'':>8} {0:5d}")
    return text


SIZES = ((10_000, 1.5), (100_000, 15.0))
"""Readings, and seconds of each of two processors within which seven noises should be fitted to them."""

PUBLISHED = (("LowLevelParticleFilters.jl", 0.017676814), ("FilterPy, there", 6.390492916))
"""Seconds of one fold of 50,000 steps, n = 4, m = 2, from docs/src/benchmark.md of LowLevelParticleFilters.jl."""

THEIR_READINGS = 300
"""Readings of the loop over FilterPy, which takes as long for one as the fit for a thousand."""


def tuning() -> Iterator[BenchmarkRow]:
    """Fit of seven noises (UKF, n = 4, with intervals and judgement) beside a loop of SciPy over FilterPy.

    Of other tuners no time is published; MATLAB's `trackingFilterTuner` shows costs per iteration and needs the truth
    (https://www.mathworks.com/help/fusion/ref/trackingfiltertuner.parametercost.html).
    """
    case = replace(next(case for case in CASES if case.twin == "motor_joint"), duration=17_000.0)
    twin, logs = logs_of(case, 1)
    fit(twin.estimator, twin.tuning, [Recording(_first(logs[0], 300))])
    for readings, bound in SIZES:
        log = _first(logs[0], readings)
        done: list[Fitted] = []
        clock, spent = both(lambda log=log, done=done: done.append(fit(twin.estimator, twin.tuning, [Recording(log)])))  # type: ignore[misc]
        figures = {"clock [s]": clock, "each of two processors [s]": spent / 2, "folds": done[0].folds}
        yield BenchmarkRow(f"{readings:,} readings", figures, (Bound("each of two processors [s]", bound),))
    spent, evaluations = _theirs(twin, _first(logs[0], THEIR_READINGS))
    yield BenchmarkRow(f"SciPy, {THEIR_READINGS} readings", {"processor [s]": spent, "folds": evaluations})
    yield BenchmarkRow("published, one step", {f"{name} [µs]": 1e6 * fold / 50_000 for name, fold in PUBLISHED})


def _first(log: Log, readings: int) -> Log:
    """Return the part with so many readings."""
    cut = log.copy()
    cut.n = int(np.flatnonzero(log.events.kind == READING)[readings - 1]) + 1
    return cut


def _theirs(twin: Twin, log: Log) -> tuple[float, int]:
    """Return seconds and evaluations of a plain loop of SciPy over FilterPy."""
    model, n = twin.model, twin.model.nx
    p = model.default_parameters
    events = log.events
    prior = model.prior_mean, np.diag(model.prior_std**2)

    def fx(x: np.ndarray, dt: float, u: np.ndarray) -> np.ndarray:
        out = np.empty(n)
        model.f(x, u, p, dt, out)
        return out

    def hx(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        out = np.empty(3)
        for sensor in model.sensors:
            k = model.sensor_names.index(sensor.name)
            sensor.h(x, u, p, out[k : k + 1])
        return out

    def negative(theta: np.ndarray) -> float:
        q, r = np.exp(theta[:n]), np.exp(theta[n:])
        points = MerweScaledSigmaPoints(n, alpha=0.5, beta=2.0, kappa=0.0)
        ukf = UnscentedKalmanFilter(n, 3, 1.0, hx, fx, points)
        ukf.x, ukf.P, ukf.R = prior[0].copy(), prior[1].copy(), np.diag(r)
        u, clock, total = model.default_inputs, events.t[0], 0.0
        for t in np.unique(events.t):
            if t > clock:
                ukf.Q = np.diag(q * (t - clock) * 1e-9)
                ukf.predict(dt=(t - clock) * 1e-9, u=u)
                clock = t
            now = np.flatnonzero(events.t == t)
            for k in now[events.kind[now] == INPUT]:
                u = np.where(np.isfinite(events.value[k, : u.size]), events.value[k, : u.size], u)
            readings = now[events.kind[now] == READING]
            # Its update uses the points of the last prediction, so simultaneous measurements are joined.
            if readings.size == 3 and t > events.t[0]:
                y = np.empty(3)
                y[events.channel[readings]] = events.value[readings, 0]
                ukf.update(y, u=u)
                total += ukf.log_likelihood
        return -total

    start = np.log(np.concatenate([twin.tuning.q, twin.tuning.r]))
    begun = process_time()
    found = minimize(negative, start, method="L-BFGS-B", bounds=[(value - 9.0, value + 9.0) for value in start])
    return process_time() - begun, int(found.nfev)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("twins", nargs="*", help="only these")
    parser.add_argument("--logs", type=int, default=50)
    arguments = parser.parse_args()
    for case in CASES:
        if not arguments.twins or case.twin in arguments.twins:
            print("\n".join(lines(case, recover(case, arguments.logs))), flush=True)


if __name__ == "__main__":
    main()
