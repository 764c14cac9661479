"""What `nisus fold --smooth` says of the smoother: how far it was off, and whether it agrees with the filter."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from estimators.diagnostics.calibration import BANDS, Calibration, calibrations, truth_calibration
from estimators.diagnostics.episodes import Episode, episode_json
from estimators.diagnostics.failure_cause import failures
from estimators.diagnostics.intervals import Interval
from estimators.diagnostics.score import Fit, Score, score
from estimators.diagnostics.sensitivity.suspects import RIDDLES, Suspect, in_words, likeliest, suspects
from estimators.errors import NisusError
from estimators.fold import Fold
from estimators.fold_failures import cause_of
from estimators.gate.isolation import Decision, softened
from estimators.log import READING
from estimators.plausibility import reasons_by_sensor
from estimators.smoothing.smooth import consistency
from estimators.smoothing.smoothed import Smoothed
from estimators.track import FAILED, HEALTH_NAMES, REASONS, USED
from estimators.tuning import TOGETHER
from sources.source import WRONG_TIME

from ..present.export.calibration_lines import calibration_lines
from ..twin.twin import Twin


class Better(NamedTuple):
    """By name of the state: errors where the truth is known, and consistency with the filter."""

    states: Mapping[str, Fit]
    consistency: Mapping[str, float]

    @staticmethod
    def of(fold: Fold, smoothed: Smoothed) -> Better:
        """What came of smoothing a fold."""
        fits = score(smoothed.instead_of(fold.track), fold.log.events, fold.model, gate=fold.tuning.gate).states
        return Better(fits, consistency(fold.track, smoothed, fold.model))

    def as_dict(self) -> dict[str, Any]:
        """For a script."""
        told = {name: number(value) for name, value in self.consistency.items()}
        return {**errors_dict(self.states), "consistency": told}

    def as_rows(self, units: Mapping[str, str]) -> list[tuple[str, str]]:
        """Names and values, as the report has them."""
        rows = [
            (f"RMSE {name}, smoothed", f"{fit.rmse:.5g} {units[name]}   in the 95 % band: {100 * fit.coverage:.1f} %")
            for name, fit in self.states.items()
        ]
        told = [f"{name} {value:.2f}" for name, value in self.consistency.items() if np.isfinite(value)]
        return [*rows, ("smoother against filter", ", ".join(told) + "   1 where the model holds")] if told else rows


def errors_dict(states: Mapping[str, Fit]) -> dict[str, dict[str, float | None]]:
    """Root mean square errors of states, and how many of them lie in the 95 % band."""
    return {
        "rmse": {name: number(fit.rmse) for name, fit in states.items()},
        "coverage": {name: number(fit.coverage) for name, fit in states.items()},
    }


def number(value: float) -> float | None:
    """As JSON has it: null where there is none."""
    return float(value) if np.isfinite(value) else None


SHOWN = 10

ASKED = 3
"""Episodes whose cause is looked for, the first ones: each takes a refold for every sensor, input and parameter."""


class Told(NamedTuple):
    """An episode, and the faults that explain it best."""

    episode: Episode
    suspects: tuple[Suspect, ...]


MANY = 0.05
"""Share of readings that never came into the log from which nothing that it says is to be trusted."""


def dropped(counts: Mapping[str, int], fold: Fold) -> list[Episode]:
    """An episode of what was dropped before the log, if that was much."""
    lost = counts.get("stale", 0) + counts.get(WRONG_TIME, 0)
    kept = int(np.sum(fold.log.kind[: fold.n] == READING))
    share = lost / max(1, lost + kept)
    if share < MANY:
        return []
    t = fold.log.t[: fold.n] * 1e-9
    text = (
        f"{100 * share:.3g} % of the readings were dropped, {lost} of {lost + kept}: too late, or with a time that "
        "cannot be true; check the times of the source, or lengthen time.horizon"
    )
    return [Episode(float(t[0]), None, "twin", "dropped", share, math.nan, math.nan, "", text)]


def blamed(fold: Fold, episodes: Sequence[Episode]) -> list[Told]:
    """The episodes, the first of those in which readings are shifted with whoever may be to blame."""
    told: list[Told] = []
    asked = 0
    for episode in episodes:
        found: tuple[Suspect, ...] = ()
        if episode.cause in RIDDLES and asked < ASKED:
            asked += 1
            found = _suspects(fold, episode)
        told.append(Told(episode, found))
    return told


def _suspects(fold: Fold, episode: Episode) -> tuple[Suspect, ...]:
    try:
        return likeliest(suspects(fold.estimator.name, fold.model, fold.tuning, fold.log, episode.start))
    except NisusError:
        return ()


def as_json(told: Told) -> dict[str, Any]:
    """An episode for JSON, with its suspects."""
    return {
        **episode_json(told.episode),
        "suspects": [
            {
                "kind": suspect.nudge.kind,
                "name": suspect.nudge.name,
                "size": suspect.size,
                "deviation": suspect.deviation,
                "unit": suspect.nudge.unit,
                "log_likelihood": suspect.gain,
            }
            for suspect in told.suspects
        ],
    }


def episode_lines(told: Sequence[Told]) -> Iterator[str]:
    """A heading and a line each; a word where there are none."""
    if not told:
        yield "no episodes: nothing that the tests could see was wrong"
        return
    yield f"{len(told)} episode(s); docs/alarms.md says what each cause means"
    for episode, found in told[:SHOWN]:
        lasted = "at the end" if episode.end is None else f"for {episode.end - episode.start:.3g} s"
        yield f"  {episode.cause}, {lasted}: {episode.text}"
        if found:
            yield f"    most likely off: {in_words(found)}"
    if len(told) > SHOWN:
        yield f"  and {len(told) - SHOWN} more; --json has them all"


DECISIONS = 10
"""On sensors that stayed refused, that are printed at most: the last ones; --json has all."""


def calibration_of(twin: Twin, fold: Fold) -> list[Calibration]:
    """How far the bands can be believed: of every sensor row, and of every state whose truth is told."""
    events, track = fold.log.events, fold.track
    rows = calibrations(twin.model, events, track, gate=twin.tuning.gate, marginal=fold.marginal)
    return rows + truth_calibration(twin.model, events, track)


def _softened(fold: Fold) -> int:
    """How many readings lay beyond a soft gate and counted with their noise inflated."""
    return int(np.sum(softened(fold.track, fold.gate_limits)))


def _decision(decision: Decision) -> dict[str, Any]:
    """A decision on a sensor that stayed refused; times in seconds of the log, evidence null where none was weighed."""
    return {**decision._asdict(), "evidence": number(decision.evidence)}


def _decimals(number: float) -> str:
    """A number with four decimals, or four digits where that is more than a line can hold."""
    return f"{number:.4f}" if abs(number) < 1e6 else f"{number:.4g}"


def as_dict(
    twin: Twin,
    result: Score,
    found: Sequence[Calibration],
    seconds: float,
    counts: Counter[str],
    fold: Fold,
    told: Sequence[Told],
    smoothed: Better | None = None,
) -> dict[str, Any]:
    """What a script needs of a fold.

    `rmse` and `coverage` (the share of errors inside their 95 % band) are by state and `held_out` by sensor row, in
    their units; `stale` counts the readings that came too late to be among the `readings`, `wrong_time` the events that
    were refused for a time that cannot be true, `inflated` the late ones that were used when they came, `conditioned`
    those that a condition of the source's map refused; `screened` counts what the edge refused by sensor and reason,
    these last among them as `condition`; `late` and `degraded_after` say what was decided of time, and why; `health` is
    the share of the track's rows in each state of health.
    `log_likelihood` has the price of the readings that were refused, which `log_likelihood_used` leaves out; `refused`
    is their share. `calibration` has an entry for each sensor row, used or held out, and each state whose truth is
    told: see estimators/diagnostics/calibration.py. `episodes` have start and end in seconds of the log (end null while
    one lasts), and `suspects`, the faults that explain them best: see estimators/diagnostics/episodes/ and
    sensitivity/suspects.py. `smoothed`, where that was asked for, has `rmse` and `coverage` of the smoothed states, and
    `consistency` with the filter: see estimators/smoothing/consistency.py.
    """
    return {
        "twin": twin.name,
        "estimator": twin.estimator,
        "tuning": twin.tuning.name,
        "readings": result.readings,
        **({"field": {"rmse": result.field.rmse, "coverage": result.field.coverage}} if result.field else {}),
        **errors_dict(result.states),
        **({"smoothed": smoothed.as_dict()} if smoothed is not None else {}),
        "held_out": {
            name: {"rmse": number(fit.rmse), "bias": number(fit.bias), "coverage": number(fit.coverage)}
            for name, fit in result.held_out.items()
        },
        "nis": {
            "mean": number(result.nis),
            "low": number(result.nis_low),
            "high": number(result.nis_high),
            "n": result.nis_readings,
        },
        "log_likelihood": number(result.log_likelihood),
        "log_likelihood_used": number(result.log_likelihood_used),
        "used": int(np.sum(fold.track.verdict == USED)),
        "stale": counts["stale"],
        "wrong_time": counts[WRONG_TIME],
        "inflated": counts["inflated"],
        "late": twin.late._asdict(),
        "degraded_after": twin.degraded._asdict(),
        "conditioned": sum(count for key, count in counts.items() if key.startswith("condition ")),
        "gated": result.gated,
        "softened": _softened(fold),
        "gate": [_decision(decision) for decision in fold.decisions],
        "refused": number(result.refused),
        "missing": result.missing,
        "failed": int(np.sum(fold.track.verdict == FAILED)),
        "screened": _screened(twin, counts, fold),
        "failure": _why(fold),
        "account": {name: said if isinstance(said, list) else number(said) for name, said in fold.account().items()},
        "health": {
            name: float(share)
            for name, share in zip(
                HEALTH_NAMES, np.bincount(fold.track.health, minlength=len(HEALTH_NAMES)) / len(fold.track), strict=True
            )
        },
        "calibration": [calibration_dict(entry) for entry in found],
        "episodes": [as_json(item) for item in told],
        "seconds_per_event": seconds,
    }


def calibration_dict(entry: Calibration) -> dict[str, Any]:
    """One calibration, for JSON."""

    def figure(found: Interval) -> dict[str, float | None]:
        return {name: number(value) for name, value in zip(Interval._fields, found, strict=True)}

    return {
        **{name: getattr(entry, name) for name in ("subject", "role", "start", "end", "n")},
        **{name: figure(getattr(entry, name)) for name in ("ratio", "scale", "bias", "correlation", "refused")},
        "coverage": {f"{100 * band:.0f}": figure(share) for band, share in zip(BANDS, entry.coverage, strict=True)},
        "words": list(entry.words),
    }


def _screened(twin: Twin, counts: Counter[str], fold: Fold) -> dict[str, dict[str, int]]:
    """By sensor and reason, how many readings were not to be used, wholly or in part; only sensors that have any.

    `condition`: a signal beside it said that the reading is not valid.
    """
    names = twin.model.sensor_names
    table = reasons_by_sensor(len(names), fold.log.channel[: fold.n], fold.track.screened)
    found = {name: dict(zip(REASONS, row.tolist(), strict=True)) for name, row in zip(names, table, strict=True)}
    for name, each in found.items():
        each["condition"] = counts[f"condition {name}"]
    every = {name: {reason: count for reason, count in each.items() if count} for name, each in found.items()}
    return {name: each for name, each in every.items() if each}


def _why(fold: Fold) -> str | None:
    """What of the model made the first reading or estimate fail that did."""
    rows = failures(fold.track)
    return cause_of(fold, int(rows[0])) if rows.size else None


def as_text(
    twin: Twin,
    result: Score,
    found: Sequence[Calibration],
    seconds: float,
    counts: Counter[str],
    fold: Fold,
    smoothed: Better | None = None,
) -> list[str]:
    """Lines: names and values, then the calibration."""
    track = fold.track
    units = {state.name: state.unit for state in twin.model.shown_states}
    grid = twin.model.grid
    rows = [
        ("twin", f"{twin.name}: {twin.title}"),
        ("estimator", twin.estimator),
        ("tuning", twin.tuning.name),
        ("readings", f"{result.readings}"),
    ]
    model = twin.model
    if result.field is not None and grid is not None:
        fit = result.field
        inside = f"in the 95 % band: {100 * fit.coverage:.1f} %"
        rows.append((f"RMSE {grid.name}, all cells whose truth is known", f"{fit.rmse:.5g} {grid.unit}   {inside}"))
    rows += [
        (model.label(name), f"{track.mean[-1, k]:.3f} at the end   Brier score (mean square error): {fit.rmse**2:.5g}")
        if model.mode >= 0 and name == model.state_names[model.mode]
        else (f"RMSE {name}", f"{fit.rmse:.5g} {units[name]}   in the 95 % band: {100 * fit.coverage:.1f} %")
        for k, (name, fit) in enumerate(result.states.items())
    ]
    if smoothed is not None:
        rows += smoothed.as_rows(units)
    if result.nis_readings:
        verdict = result.nis_verdict
        bounds = f"{verdict.said}; {result.nis_readings} readings"
        rows.append(("mean NIS", f"{_decimals(result.nis)}   {bounds}"))
    # The many rows of one sensor are one line.
    together = {}
    for sensor, start in zip(twin.model.sensors, twin.model.row_start, strict=True):
        names = [name for name in twin.model.row_names[start : start + len(sensor.rows)] if name in result.held_out]
        if len(names) >= TOGETHER and len({row.unit for row in sensor.rows}) == 1:
            together[sensor.name] = names
    many = {name for names in together.values() for name in names}
    refusals = f"   without what was refused {result.log_likelihood_used:.2f}" if result.gated else ""
    rows += [
        ("log-likelihood", f"{result.log_likelihood:.2f}" + refusals),
        ("gated", f"{result.gated}" + (f"   {100 * result.refused:.2g} % of the readings" if result.gated else "")),
        *([("softened", f"{_softened(fold)}")] if fold.tuning.gate_kind == "soft" else []),
        ("missing", f"{result.missing}"),
    ]
    failed = int(np.sum(track.verdict == FAILED))
    if failed:
        rows.append(("failed", f"{failed}: no estimate, or none with this reading, is a number"))
    for name, reasons in _screened(twin, counts, fold).items():
        rows.append((f"not used of {name}", ", ".join(f"{reason} {count}" for reason, count in reasons.items())))
    conditions = {f"condition {name}" for name in twin.model.sensor_names}
    why = _why(fold)
    if why:
        rows.append((f"the model failed {fold.failures} time(s)" if fold.failures else "because", why))
    row_units = dict(
        zip(twin.model.row_names, [row.unit for sensor in twin.model.sensors for row in sensor.rows], strict=True)
    )
    rows += [
        (f"held out {name}", f"RMSE {fit.rmse:.5g} {row_units[name]}   in the 95 % band: {100 * fit.coverage:.1f} %")
        for name, fit in result.held_out.items()
        if name not in many
    ]
    for sensor_name, own in together.items():
        fits = [result.held_out[name] for name in own]
        rmse = float(np.sqrt(np.mean([fit.rmse**2 for fit in fits])))
        share = 100 * float(np.mean([fit.coverage for fit in fits]))
        text = f"RMSE {rmse:.5g} {row_units[own[0]]}   in the 95 % band: {share:.1f} %"
        rows.append((f"held out {sensor_name}, {len(own)} rows", text))
    rows += [(key, f"{count}") for key, count in sorted(counts.items()) if key not in conditions]
    variances = ", ".join(
        f"{twin.model.state_names[j]} {value**2:.5g}" for j, value in zip(twin.model.shown, track.std[-1], strict=True)
    )
    rows += [
        ("final variances", variances),
        ("late readings", f"{'used when they come, R inflated' if twin.late.inflate else 'exact'}: {twin.late.reason}"),
        ("degraded after", f"{twin.degraded.seconds:g} s without a reading: {twin.degraded.reason}"),
        *((f"at {decision.time:.1f} s", decision.text) for decision in fold.decisions[-DECISIONS:]),
        (
            "health at the end",
            # The track has no rows of measurements that never reached the log, so its health cannot show them.
            f"degraded: {lost[0].size:.0%} of the measurements were dropped"
            if (lost := dropped(counts, fold))
            else HEALTH_NAMES[int(track.health[-1])],
        ),
        ("time per event", f"{1e6 * seconds:.2f} µs"),
    ]
    width = max(len(name) for name, _ in rows)
    lines = [f"{name:<{width}}  {value}" for name, value in rows]
    said = calibration_lines(found, twin.model)
    return lines + (["calibration, 95 % intervals:", *(f"  {line}" for line in said)] if said else [])
