"""`python -m tests.benchmarks.bands`: bands that hold model error, from the first half of real recordings.

Each twin with recordings is folded three times with the same values: with every parameter held (before), as its file
has it (own), and with every parameter considered, by the covariance that the first half of its own recording gives them
and its `widen` (after). Widths without data are those of its file, or 10 %. All are scored on the second half, and on
whole recordings that no fit saw (`UNSEEN`, and `--log TWIN=FILE`), against true states and held-out sensors: error
(RMS), mean 2 σ, share in the 95 % band, share withheld, health. The target is 90 to 98 % in the band or withheld, and σ
at most three times the error. `--fit` first fits the parameters to the first half too.

`--faults N` instead takes simulated assets, whose truth is known: the share of N random faults of sizes that
`nisus check` lists as undetectable under which the error stays below its bound, and the share of the truth in the band
of N twins with every parameter off by chance, by 10 % (`LEVELS`), as they consider it, over the second half of a log of
its own. Both should be at least 95 %. A band at one time of few logs is no measure: the same noise decides many draws.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from app.extensions.lab.stress.scenario import Bench
from app.study.calibration_lines import health_shares
from app.twin.defaults import bounds_of, natural_aim, width_priors
from app.twin.log_reader import read_log
from app.twin.twin import Twin, load_twin, with_held
from app.twin.versions import Settings, version_text
from estimators.diagnostics.references import references
from estimators.diagnostics.score import health_of
from estimators.diagnostics.sensitivity import bounds_of as levels_of
from estimators.diagnostics.sensitivity import sensitivities
from estimators.diagnostics.sensitivity.responses import BY_ALARMS, SWITCHED, start
from estimators.errors import NisusError
from estimators.events.batch import Events, truth_of
from estimators.fit.aims import aim_of
from estimators.fit.entries import Setting
from estimators.fit.fit import fit
from estimators.fit.judge import Z
from estimators.fit.recording import Recording
from estimators.fit.uncertainty import parameter_widths
from estimators.log import Log
from estimators.model.parts import Field
from estimators.track import Track
from tests.support import folded

from ..skips import data_folder
from .recordings import CASES, GOOD, Case, halves

OTHERS = (Case("motor_bench_hybrid"), Case("field_era5"))
MAX_RATIO = 3.0  # σ over error on fitted data

SIMULATED = (("motor_winding", 300.0), ("motor_can", 200.0), ("motor_joint", 120.0), ("battery_pack", 300.0))
"""Twins with a simulated asset, and seconds of their logs."""

ASSETS = 200  # logs among which random faults are spread
WIDTH = "10 %"  # of parameters that are off by chance
LEVELS = {"ocv_": 0.01}
"""Width of parameters that are levels and not scales, in their unit, by the start of their names.

A tenth of what neighbouring points of the open-circuit curve differ by, V: with 10 % of its values, 0.35 V, the curve
falls where it should rise, no charge belongs to a voltage, and no linear band holds (0 to 2 % of the charges).
"""

UNSEEN = {
    "battery_panasonic": ("battery_panasonic_18650pf/25degC_5pulse_HPPC.mat",),
    "battery_dmegc": ("battery_dmegc_18650/Exp25_R1.mat",),
}
"""Recordings of the twin's asset or of another specimen, by twin."""


def considered(twin: Twin, first: Log, *, fitted: bool) -> tuple[Settings, str]:
    """Return the settings that a fit to the first half gives a twin, and what the data said, in words."""
    held = with_held(twin)
    prior = width_priors(twin.config, held.model, ()) or width_priors(twin.config, held.model, ("p",))
    recording, setting = Recording(first, 1.0, np.zeros(first.n, bool)), Setting(held.tuning, None)
    if fitted:
        found = fit(
            twin.estimator, held.tuning, [recording], wanted=[f"p.{name}" for name in prior],
            bounds=bounds_of(twin.config, held.model), aim=natural_aim(twin.config), considered=prior,
        )  # fmt: skip
        setting, widths = found.setting, found.widths
    else:
        aim = aim_of(natural_aim(twin.config), twin.estimator, setting, [recording], ())
        widths = parameter_widths(twin.estimator, setting, [recording], prior, aim=aim)
    assert widths is not None
    left = widths.std / widths.prior
    told = f"{np.sum(left < 0.5)} of {left.size} widths less than half of what they are without data"
    return Settings(twin.estimator, setting.tuning, widths=widths), f"{told}, inflation {widths.inflation:.3g}"


def verdict(coverage: float, ratio: float) -> str:
    """Return what misses the target, in words."""
    missed = ["too few" if coverage < GOOD[0] else "too many" if coverage > GOOD[1] else ""]
    missed.append(f"σ {ratio:.1f} times the error" if ratio > MAX_RATIO else "")
    return ", ".join(filter(None, missed)) or "good"


def score(twin: Twin, log: Log, part: np.ndarray, what: str) -> None:
    """Print a line for each true state and held-out row of a part (n,) of a log."""
    fold = folded(twin.estimator, twin.model, log, twin.tuning, policy=twin.policy)
    events, track = log.events, fold.track
    health = health_shares(health_of(events.select(part), track.select(part), twin.policy))
    limits = {state.name: state.withhold for state in twin.model.shown_states}
    for item in references(twin.model, events, track):
        kept = part[item.rows]
        error, std = item.error[kept], item.std[kept]
        if not error.size:
            continue
        shown = Z * std <= limits.get(item.name, np.inf)
        inside = np.abs(error) <= Z * std
        rms = float(np.sqrt(np.mean(error**2)))
        coverage, said = "     -", "withheld"
        if shown.any():
            coverage, said = f"{inside[shown].mean():6.1%}", verdict(float(inside[shown].mean()), std.mean() / rms)
        print(
            f"    {what:8s} {item.name:18s} error {rms:9.4g}  2 σ {2 * std.mean():9.4g} {item.unit:5s} "
            f"in band {coverage}, of all {inside.mean():6.1%}, withheld {1 - shown.mean():6.1%}  {said:10s} {health}",
            flush=True,
        )


def report(name: str, seconds: float | None, more: Sequence[Path], *, fitted: bool) -> None:
    """Print the table of one twin."""
    twin = load_twin(name)
    log = read_log(twin, seconds)[0]
    first, second = halves(log)
    if isinstance(twin.model.states, Field):
        print(f"{name}: a field, whose parameters are held")
        score(twin, log, second, "own")
        return
    settings, words = considered(twin, first, fitted=fitted)
    print(f"{name}: {words}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "considered.yaml"
        path.write_text(version_text(twin, settings), encoding="utf-8")
        for file in (None, *more):
            files = None if file is None else [file]
            after = load_twin(name, log_files=files, overrides={"tuning": str(path)})
            if file is not None:
                log = read_log(after, None)[0]
                second = np.ones(log.n, bool)
            print(f"  {'second half' if file is None else file.name}")
            score(with_held(after), log, second, "before")
            if twin.model.considered:
                score(load_twin(name, log_files=files), log, second, "own")
            score(after, log, second, "after")


def errors_of(twin: Twin, truth: Events, track: Track) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return errors and standard deviations of each state at its known true values, (n,) each."""
    found = {}
    for k, state in enumerate(twin.model.shown_states):
        rows, values = truth_of(truth, int(twin.model.shown[k]))
        rows, values = np.asarray(rows), np.asarray(values)
        within = rows < len(track)
        if within.any():
            rows = rows[within]
            found[state.name] = track.mean[rows, k] - values[within], track.std[rows, k]
    return found


def bounds_held(twin: Twin, seconds: float, count: int) -> list[tuple[str, bool]]:
    """Return for random undetectable faults of a twin, state by state, whether the error is below its bound."""
    calm = Bench(twin, 0, seconds).fold(None, twin.estimator, twin.tuning.gate).fold
    found = sensitivities(
        twin.estimator, calm.model, calm.tuning, calm.log, false_alarm=twin.policy.false_alarm_every
    )  # fmt: skip
    levels = levels_of(calm.model, *found)
    listed = [
        (one, fault)
        for one in found[:2]
        for fault in one.faults
        if fault.nudge.kind not in (*BY_ALARMS, *SWITCHED) and -np.inf < fault.low < fault.high < np.inf
    ]
    rng, assets, held = np.random.default_rng(0), {}, []
    for i in range(count):
        one, fault = listed[rng.integers(len(listed))]
        key = 1 + i % ASSETS, one.begin
        if key not in assets:
            other = Bench(twin, key[0], seconds).fold(None, twin.estimator, twin.tuning.gate)
            begun = start(twin.estimator, calm.model, other.fold.tuning, other.fold.log, None, len(one.t), one.begin)
            assets[key] = begun, other.truth.select(slice(begun.first, None))
        begun, truth = assets[key]
        track = begun.with_fault(fault.nudge, rng.uniform(fault.low, fault.high))
        held += [(name, abs(e[-1]) <= levels[name].bound) for name, (e, _) in errors_of(twin, truth, track).items()]
    return held


def widths_held(name: str, seconds: float, count: int) -> list[tuple[str, float]]:
    """Return for twins whose parameters are off by chance, state by state, the share of the truth in the band."""
    plain = load_twin(name)
    off = [item for item, value in zip(plain.model.parameters, plain.tuning.p, strict=True) if value != 0.0]
    if not off:
        return []
    level = {item.name: next((w for start, w in LEVELS.items() if item.name.startswith(start)), None) for item in off}
    stds = {f"parameters.{key}.std": WIDTH if width is None else str(width) for key, width in level.items()}
    twin = load_twin(name, overrides=stds)
    share, rng, held = float(WIDTH.split()[0]) / 100.0, np.random.default_rng(1), []
    logs = [
        Bench(plain, 1 + k, seconds).fold(None, plain.estimator, plain.tuning.gate) for k in range(min(ASSETS, count))
    ]
    for i in range(count):
        p = twin.tuning.p.copy()
        for item in off:
            k = [parameter.name for parameter in twin.model.parameters].index(item.name)
            # The width is a share of the file's value, so that is what a twin is off by.
            std = level[item.name] or share * p[k]
            p[k] = np.clip(p[k] - std * rng.standard_normal(), item.low, item.high)
        log = logs[i % ASSETS]
        fold = folded(twin.estimator, twin.model, log.fold.log, replace(twin.tuning, p=p), policy=twin.policy)
        errors = errors_of(twin, log.truth, fold.track)
        held += [(state, np.mean((np.abs(e) <= Z * std)[e.size // 2 :])) for state, (e, std) in errors.items()]
    return held


def report_random(name: str, seconds: float, count: int) -> None:
    """Print how often bounds and bands hold on simulated assets of a twin, and the states for which they do not."""
    for what, held in (
        ("bounds under listed faults", bounds_held(load_twin(name), seconds, count)),
        (f"bands with parameters off by {WIDTH}", widths_held(name, seconds, count)),
    ):
        if not held:
            continue
        states = {state: [good for name, good in held if name == state] for state, _ in held}
        words = ", ".join(f"{state} {np.mean(good):.1%}" for state, good in states.items())
        print(f"{name}: {what} hold {np.mean([good for _, good in held]):.1%} of {len(held)}: {words}", flush=True)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("twins", nargs="*", help="default: all with recordings")
    parser.add_argument("--log", action="append", default=[], metavar="TWIN=FILE", help="a recording no fit saw")
    parser.add_argument("--fit", action="store_true", help="fit the parameters to the first half, too")
    parser.add_argument("--faults", type=int, metavar="N", help="random faults of simulated assets instead")
    given = parser.parse_args()
    if given.faults:
        for name, seconds in SIMULATED:
            if not given.twins or name in given.twins:
                report_random(name, seconds, given.faults)
        return
    more = {name: [data_folder() / file for file in files] for name, files in UNSEEN.items()}
    for text in given.log:
        twin, _, file = text.partition("=")
        more.setdefault(twin, []).append(Path(file))
    for case in (*CASES, *OTHERS):
        if given.twins and case.twin not in given.twins:
            continue
        try:
            report(case.twin, case.seconds, more.get(case.twin, []), fitted=given.fit)
        except NisusError as error:
            print(f"{case.twin}: {error}", flush=True)


if __name__ == "__main__":
    main()
