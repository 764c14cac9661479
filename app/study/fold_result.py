"""Result of a fold: scores, calibration, rejected measurements and fault episodes with their suspects."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from estimators.diagnostics.calibration import (
    BANDS,
    WHOLE,
    Calibration,
    CoverageBin,
    calibrations,
    coverage_bins,
    held_inputs,
    truth_calibration,
)
from estimators.diagnostics.considered_shares import known_stds, source_texts, variance_shares
from estimators.diagnostics.consistency import nees
from estimators.diagnostics.episodes import Episode, episode_json, episodes
from estimators.diagnostics.failure_cause import failures
from estimators.diagnostics.references import WITHHELD, own_grades, state_grades, state_health, withheld
from estimators.diagnostics.score import Fit, Score, health_of, score
from estimators.diagnostics.sensitivity.suspects import Suspect, in_words, isolates, likeliest, odds, suspects
from estimators.errors import NisusError
from estimators.fold import Fold
from estimators.fold_failures import cause_of
from estimators.gate.isolation import softened
from estimators.log import READING, Events, Log, truth_of
from estimators.plausibility import reasons_by_sensor
from estimators.registry import find_entry
from estimators.smoothing.smooth import consistency
from estimators.smoothing.walk import Smoothed
from estimators.track import FAILED, HEALTH_NAMES, REASONS, USED, Track
from estimators.tuning import SHARED_ENTRY_ROWS
from sources.source import WRONG_TIME

from ..columns import units_by_name
from ..format_time import counted, duration_text, format_time
from ..leading import leading, states_of_rows
from ..result import Figure, JsonObject, Topic, plain
from ..twin.ingest import dropped_episode
from ..twin.twin import Twin
from .calibration_lines import COVERAGE_HEAD, calibration_lines, coverage_rows, health_shares
from .scores import pictures_of

MAX_DECISIONS = 10  # latest decisions on rejected sensors that are printed; JSON has all
MAX_EPISODES = 10  # first episodes that are printed; JSON has all
MAX_EXPLAINED = 3  # first episodes whose cause is searched for: each takes one fold per sensor, input and parameter
GAUSSIAN = "Gaussian"
MAX_SAMPLED_STATES = 12  # states whose covariances of members or particles cost little beside a step
MAX_COVARIANCE_BYTES = 200_000_000
MIN_DROPPED_SHARE = 0.05  # share of measurements missing from the log above which the result is degraded


class ExplainedEpisode(NamedTuple):
    """An episode, and the faults that explain it best."""

    episode: Episode
    suspects: tuple[Suspect, ...]
    words: str = ""


class SmoothingScore(NamedTuple):
    """Errors of the smoothed states whose truth is known, and their consistency with the filter, by state."""

    states: Mapping[str, Fit]
    consistency: Mapping[str, float]


class TruthNees(NamedTuple):
    """Mean NEES per degree of freedom with the bounds of a consistent filter, over `n` times with known `states`.

    inside: share of the times whose own NEES lies in its 95 % bounds.
    """

    mean: float
    low: float
    high: float
    inside: float
    states: tuple[str, ...]
    n: int

    @property
    def remark(self) -> str:
        """Its position relative to the bounds."""
        share = f"{100.0 * self.inside:.1f} % of {self.n:,} times inside their own"
        if not np.isfinite(self.low):
            return f"per degree of freedom; {share}"
        place = "below" if self.mean < self.low else "above" if self.mean > self.high else "inside"
        return f"per degree of freedom, {place} its 95 % bounds {self.low:.3g} to {self.high:.3g}; {share}"


@dataclass(frozen=True)
class FoldResult:
    """A finished fold and its scores, each computed once when first needed.

    `seconds` is the time per event, `part` the scored rows, `known` the states whose NEES is computed.
    """

    twin: Twin
    fold: Fold
    counts: Counter[str]
    seconds: float
    part: slice
    known: Sequence[int] = ()
    smoothed: Smoothed | None = None

    @cached_property
    def events(self) -> Events:
        """The scored events."""
        return self.fold.log.events.select(self.part)

    @cached_property
    def track(self) -> Track:
        """Their rows."""
        return self.fold.track.select(self.part)

    @cached_property
    def scored(self) -> Score:
        """Their scores."""
        pictures, tuning = pictures_of(self.fold, self.part), self.twin.tuning
        return score(self.track, self.events, self.twin.model, pictures, gate=tuning.gate, baseline=tuning.baseline)

    @cached_property
    def episodes(self) -> list[ExplainedEpisode]:
        """Episodes that overlap their time, with suspects."""
        lost = dropped(self.counts, self.fold)
        return explained(self.fold, [*lost, *within(episodes(self.fold), self.events)])

    @cached_property
    def smoothing(self) -> SmoothingScore | None:
        """Scores of the smoothed states; None if they were not requested."""
        if self.smoothed is None:
            return None
        own, model = self.smoothed.select(self.part), self.fold.model
        fits = score(own.instead_of(self.track), self.events, model, gate=self.fold.tuning.gate).states
        return SmoothingScore(fits, consistency(self.track, own, model))

    @cached_property
    def truth_nees(self) -> TruthNees | None:
        """NEES over the `known` states, whose covariances the fold kept; None without one."""
        if not any(truth_of(self.events, j)[0].size for j in self.known):
            return None
        found = nees(self.fold.model, self.events, self.track, self.fold.pairs, self.known)
        times = int(np.isfinite(found.value).sum())
        names = tuple(self.fold.model.state_names[j] for j in self.known)
        return TruthNees(found.mean, *found.mean_bounds, found.inside, names, times) if times else None


def rows_of(log: Log, span: tuple[int, int] | None) -> slice:
    """Return the rows of a log between two times, ns; all without."""
    return slice(*(map(int, np.searchsorted(log.t[: log.n], span)) if span else (0, log.n)))


def within(found: Sequence[Episode], events: Events) -> list[Episode]:
    """Return the episodes that overlap the time of some events."""
    first, last = float(events.t[0]) * 1e-9, float(events.t[-1]) * 1e-9
    return [item for item in found if item.start <= last and (item.end is None or item.end >= first)]


def known_states(twin: Twin, events: Events) -> list[int]:
    """Return the states whose NEES is computed: those with a known truth, except a discrete mode.

    None where their covariances would cost too much: many states of a filter without P.
    """
    return with_covariance(twin, events, [int(j) for j in twin.model.shown if truth_of(events, int(j))[0].size])


def with_covariance(twin: Twin, events: Events, states: Iterable[int]) -> list[int]:
    """Return these states but a discrete mode; none where their covariances would cost too much time or memory."""
    found = [int(j) for j in states if j != twin.model.mode]
    pairs = len(found) * (len(found) - 1) // 2
    small = pairs * len(events) * 8 <= MAX_COVARIANCE_BYTES
    keeps = find_entry(twin.estimator).family == GAUSSIAN or len(found) <= MAX_SAMPLED_STATES
    return found if small and keeps else []


def pairs_with(twin: Twin, states: Sequence[int]) -> np.ndarray:
    """Return the pairs of the twin's view, then all pairs of these states."""
    every = [(i, j) for k, i in enumerate(states) for j in states[k + 1 :]]
    return np.array([*map(tuple, twin.pairs), *every], int).reshape(-1, 2)


def calibration_of(fold: Fold, events: Events, track: Track) -> list[Calibration]:
    """Return the calibration of every sensor row, and of every state whose truth is known, in rows of a fold."""
    rows = calibrations(fold.model, events, track, gate=fold.tuning.gate, marginal=fold.marginal)
    return rows + truth_calibration(fold.model, events, track)


def coverage_of(fold: Fold, part: slice) -> list[CoverageBin]:
    """Return the coverage of the bands in some rows of a fold, by time and operating point."""
    inputs = held_inputs(fold.model, fold.log.events)[part]
    return coverage_bins(
        fold.model, fold.log.events.select(part), fold.track.select(part), inputs, marginal=fold.marginal
    )


def dropped(counts: Mapping[str, int], fold: Fold) -> list[Episode]:
    """Return an episode if many measurements never reached the log."""
    lost = counts.get("stale", 0) + counts.get(WRONG_TIME, 0)
    kept = int(np.sum(fold.log.kind[: fold.n] == READING))
    if lost < MIN_DROPPED_SHARE * max(1, lost + kept):
        return []
    return [dropped_episode(float(fold.log.t[0]) * 1e-9, lost, lost + kept)]


def explained(fold: Fold, listed: Sequence[Episode]) -> list[ExplainedEpisode]:
    """Add suspects to the first episodes with shifted measurements."""
    found: list[ExplainedEpisode] = []
    searched = 0
    for episode in listed:
        named: tuple[Suspect, ...] = ()
        words = ""
        if isolates(episode.cause) and searched < MAX_EXPLAINED:
            searched += 1
            with suppress(NisusError):
                _, base = fold.base_at(0)
                likely = suspects(fold.estimator.name, fold.model, fold.tuning, fold.log, episode.start, base=base)
                named, words = likeliest(likely), in_words(likely)
        found.append(ExplainedEpisode(episode, named, words))
    return found


def fold_json(result: FoldResult) -> JsonObject:
    """Return a fold for scripts; docs/reference.md describes its fields."""
    twin, fold, scored, counts = result.twin, result.fold, result.scored, result.counts
    smoothing, verdict = result.smoothing, scored.nis_verdict
    cov = fold.moments()[1] if fold.model.considered else None
    found = {
        "twin": twin.name,
        "estimator": twin.estimator,
        "tuning": twin.tuning.name,
        "start": float(result.events.t[0]) * 1e-9,
        "end": float(result.events.t[-1]) * 1e-9,
        "readings": scored.readings,
        **({"field": {"rmse": scored.field.rmse, "coverage": scored.field.coverage}} if scored.field else {}),
        **_errors(scored.states),
        **({"smoothed": {**_errors(smoothing.states), "consistency": smoothing.consistency}} if smoothing else {}),
        "nees": result.truth_nees,
        "held_out": {
            name: {"rmse": fit.rmse, "bias": fit.bias, "coverage": fit.coverage}
            for name, fit in scored.held_out.items()
        },
        "nis": {
            "mean": verdict.nis,
            "low": verdict.low,
            "high": verdict.high,
            "n": scored.nis_readings,
            "dof": verdict.dof,
            "place": verdict.place,
            "white_low": verdict.white_low,
            "white_high": verdict.white_high,
        },
        "log_likelihood": scored.log_likelihood,
        "log_likelihood_used": scored.log_likelihood_used,
        "used": np.sum(result.track.verdict == USED),
        "stale": counts["stale"],
        "wrong_time": counts[WRONG_TIME],
        "inflated": counts["inflated"],
        "late": twin.late,
        "degraded_after": twin.degraded,
        "conditioned": sum(count for key, count in counts.items() if key.startswith("condition ")),
        "gated": scored.gated,
        "softened": _softened(result),
        "gate": fold.decisions,
        "refused": scored.refused,
        "missing": scored.missing,
        "failed": np.sum(result.track.verdict == FAILED),
        "screened": _screened(result),
        "failure": _failure_cause(fold),
        "account": fold.account(),
        "health": health_of(result.events, result.track, fold.policy),
        "states": _grades(result),
        "calibration": [calibration_json(entry) for entry in calibration_of(fold, result.events, result.track)],
        "coverage_bins": coverage_of(fold, result.part),
        "variance": variance_shares(fold.model, cov) if cov is not None else {},
        "known": known_stds(fold.model, cov) if cov is not None else {},
        "episodes": [_episode_json(item) for item in result.episodes],
        "seconds_per_event": result.seconds,
    }
    return plain(found)  # type: ignore[no-any-return]


def _grades(result: FoldResult) -> dict[str, JsonObject]:
    """Return grade and reason of each state at the end, and the share of time of each grade."""
    model, track, events, policy = result.twin.model, result.track, result.events, result.fold.policy
    if not len(track):
        return {}
    lasting = within([item.episode for item in result.episodes], events.select(slice(-1, None)))
    told = held_inputs(model, result.fold.log.events)[result.part][-1]
    u = np.where(np.isfinite(told), told, model.default_inputs)
    _, cause = leading(model, lasting, states_of_rows(model, result.fold.tuning.used, events, track), track, u)
    grades = state_grades(model, own_grades(model, track, u), int(track.health[-1]), cause)
    hidden, healths = withheld(model, track), (state_health(track, j) for j in range(len(grades)))
    return {
        name: {
            "grade": grade,
            "reason": reason,
            "share": health_of(events, track._replace(health=health), policy, own),
        }
        for (name, (grade, reason)), own, health in zip(grades.items(), hidden.T, healths, strict=True)
    }


def _errors(states: Mapping[str, Fit]) -> dict[str, dict[str, float]]:
    return {
        "rmse": {name: fit.rmse for name, fit in states.items()},
        "coverage": {name: fit.coverage for name, fit in states.items()},
    }


def calibration_json(entry: Calibration) -> JsonObject:
    """Return one calibration for JSON, its coverage by band."""
    coverage = {f"{100 * band:.0f}": share for band, share in zip(BANDS, entry.coverage, strict=True)}
    return {**plain(entry), "coverage": plain(coverage)}


def _episode_json(item: ExplainedEpisode) -> JsonObject:
    named = [
        {
            "kind": suspect.nudge.kind,
            "name": suspect.nudge.name,
            "size": suspect.size,
            "deviation": suspect.deviation,
            "unit": suspect.nudge.unit,
            "log_likelihood": suspect.gain,
            "odds": share,
        }
        for suspect, share in zip(item.suspects, odds(item.suspects), strict=True)
    ]
    return {**episode_json(item.episode), "suspects": named, "likely": item.words}


def _softened(result: FoldResult) -> int:
    """Return how many measurements beyond a soft gate were used with inflated noise."""
    return int(np.sum(softened(result.track, result.fold.gate_limits)))


def _screened(result: FoldResult) -> dict[str, dict[str, int]]:
    """Return how many measurements were rejected before the filter, by sensor and reason."""
    names = result.twin.model.sensor_names
    table = reasons_by_sensor(len(names), result.events.channel, result.track.screened)
    found = {
        name: {**dict(zip(REASONS, row.tolist(), strict=True)), "condition": result.counts[f"condition {name}"]}
        for name, row in zip(names, table, strict=True)
    }
    shown = {name: {reason: count for reason, count in each.items() if count} for name, each in found.items()}
    return {name: each for name, each in shown.items() if each}


def _failure_cause(fold: Fold) -> str | None:
    """Return why the model failed first, if it did."""
    rows = failures(fold.track)
    return cause_of(fold, int(rows[0])) if rows.size else None


def fold_topics(result: FoldResult) -> list[Topic]:
    """Return a fold as topics: figures, calibration, episodes."""
    twin, fold = result.twin, result.fold
    calibration = calibration_lines(calibration_of(fold, result.events, result.track), twin.model)
    topics = [Topic(f"{twin.name}: {twin.title}", figures=tuple(_figures(result)))]
    if calibration:
        topics.append(Topic("Calibration, 95 % intervals", tuple(calibration)))
    coverage = coverage_of(fold, result.part)
    if rows := coverage_rows(coverage, twin.model):
        left = sum(item.by == WHOLE for item in coverage) - len(rows)
        said = (f"The {len(rows)} lowest; {left} more are in --json.",) if left else ()
        topics.append(Topic("Coverage of the 95 % bands over time", said, COVERAGE_HEAD, tuple(rows)))
    return [*topics, episodes_topic(result.episodes)]


def _figures(result: FoldResult) -> list[Figure]:
    twin, fold, scored, counts = result.twin, result.fold, result.scored, result.counts
    model, events, track = twin.model, result.events, result.track
    units = units_by_name(model)
    found = [Figure("estimator", twin.estimator, remark=_options_text(fold)), Figure("tuning", twin.tuning.name)]
    if twin.forced_baseline:
        found.append(Figure("baseline", "forced", remark=twin.forced_baseline))
    if len(events) < fold.n:
        found.append(Figure("scored", f"{format_time(int(events.t[0]))} to {format_time(int(events.t[-1]))}"))
    found.append(Figure("readings", f"{scored.readings}"))
    if scored.field is not None and model.grid is not None:
        found.append(_rmse(f"RMSE {model.grid.name}, all cells with known truth", scored.field, model.grid.unit))
    for k, (name, fit) in enumerate(scored.states.items()):
        if model.mode >= 0 and name == model.state_names[model.mode]:
            text = f"{track.mean[-1, k]:.3f} at the end   Brier score (mean square error): {fit.rmse**2:.5g}"
            found.append(Figure(model.label(name), text))
        else:
            found.append(_rmse(f"RMSE {name}", fit, units[name]))
    if result.smoothing is not None:
        found += [_rmse(f"RMSE {name}, smoothed", fit, units[name]) for name, fit in result.smoothing.states.items()]
        shown = [f"{name} {value:.2f}" for name, value in result.smoothing.consistency.items() if np.isfinite(value)]
        if shown:
            found.append(Figure("smoother against filter", ", ".join(shown), remark="1 where the model holds"))
    if result.truth_nees is not None:
        title = "mean NEES" if len(result.truth_nees.states) > 1 else f"mean NEES of {result.truth_nees.states[0]}"
        found.append(Figure(title, result.truth_nees.mean, remark=result.truth_nees.remark))
    if scored.nis_readings:
        verdict = scored.nis_verdict
        said = f"{verdict.said}; {counted(scored.nis_readings, 'reading')}"
        found.append(Figure("mean NIS", verdict.ratio_text, remark=said))
    without = f"without rejected measurements {scored.log_likelihood_used:.2f}" if scored.gated else ""
    found += [
        Figure("log-likelihood", f"{scored.log_likelihood:.2f}", remark=without),
        Figure("gated", f"{scored.gated}", remark=f"{100 * scored.refused:.2g} % of the readings" * bool(scored.gated)),
        *([Figure("softened", f"{_softened(result)}")] if fold.tuning.gate_kind == "soft" else []),
        Figure("missing", f"{scored.missing}"),
    ]
    failed = int(np.sum(track.verdict == FAILED))
    if failed:
        found.append(Figure("failed", f"{failed}: no estimate, or none with this reading, is a number"))
    for name, reasons in _screened(result).items():
        found.append(Figure(f"not used of {name}", ", ".join(f"{key} {count}" for key, count in reasons.items())))
    if cause := _failure_cause(fold):
        found.append(Figure(f"the model failed {fold.failures} time(s)" if fold.failures else "because", cause))
    found += _held_out(result, units)
    conditions = {f"condition {name}" for name in model.sensor_names}
    found += [Figure(key, f"{count}") for key, count in sorted(counts.items()) if key not in conditions]
    variances = zip(model.shown, track.std[-1], strict=True)
    sources = source_texts(model, fold.moments()[1]) if model.considered else {}
    lost = dropped(counts, fold)
    return [
        *found,
        *(
            Figure(
                f"withheld {name}",
                f"{item['share'][WITHHELD]:.1%} of the time",
                remark=item["reason"] * (item["grade"] == WITHHELD),
            )
            for name, item in _grades(result).items()
            if item["share"][WITHHELD]
        ),
        Figure("final variances", ", ".join(f"{model.state_names[j]} {value**2:.5g}" for j, value in variances)),
        *(
            Figure(f"variance of {name}", source, remark=f"if measured, {gain}")
            for name, (source, gain) in sources.items()
        ),
        Figure(
            "late readings", f"{'used on arrival, R inflated' if twin.late.inflate else 'exact'}: {twin.late.reason}"
        ),
        Figure("degraded after", f"{duration_text(twin.degraded.seconds)} without a reading: {twin.degraded.reason}"),
        *(Figure(f"at {decision.time:.1f} s", decision.text) for decision in fold.decisions[-MAX_DECISIONS:]),
        # The track has no rows of measurements that never reached the log, so its health cannot show them.
        Figure(
            "health at the end",
            f"degraded: {lost[0].size:.0%} of the measurements were dropped"
            if lost
            else HEALTH_NAMES[int(track.health[-1])],
        ),
        Figure("health, share of time", health_shares(health_of(events, track, fold.policy))),
        Figure("time per event", f"{1e6 * result.seconds:.2f} µs"),
    ]


def _options_text(fold: Fold) -> str:
    """Return the options that the YAML or the command line gives the filter, choices by their words."""
    known = {option.name: option for option in fold.estimator.options}
    given = [(known[name], value) for name, value in fold.tuning.options.items() if name in known]
    return ", ".join(
        f"{option.name} {option.choices[round(value)] if option.choices else format(value, 'g')}"
        for option, value in given
    )


def _rmse(name: str, fit: Fit, unit: str) -> Figure:
    return Figure(name, f"{fit.rmse:.5g}", unit, f"in the 95 % band: {100 * fit.coverage:.1f} %")


def _held_out(result: FoldResult, units: Mapping[str, str]) -> list[Figure]:
    """Return the errors of held-out rows; many rows of one sensor, or those of a family, are one figure."""
    model, fits = result.twin.model, dict(result.scored.held_out)
    groups: dict[str, list[str]] = {}
    for sensor, start in zip(model.sensors, model.row_start, strict=True):
        names = [name for name in model.row_names[start : start + len(sensor.rows)] if name in fits]
        if sensor.family:
            for name in names:
                groups.setdefault(f"{sensor.family}{name.removeprefix(sensor.name)}", []).append(name)
        elif len(names) >= SHARED_ENTRY_ROWS and len({row.unit for row in sensor.rows}) == 1:
            groups[sensor.name] = names
    found = []
    for group, names in groups.items():
        own = [fits.pop(name) for name in names]
        rmse = float(np.sqrt(np.mean([fit.rmse**2 for fit in own])))
        share = 100 * float(np.mean([fit.coverage for fit in own]))
        title = f"held out {group}, {len(names)} rows"
        found.append(Figure(title, f"RMSE {rmse:.5g}", units[names[0]], f"in the 95 % band: {share:.1f} %"))
    singles = [
        Figure(f"held out {name}", f"RMSE {fit.rmse:.5g}", units[name], f"in the 95 % band: {100 * fit.coverage:.1f} %")
        for name, fit in fits.items()
    ]
    return singles + found


def episodes_topic(found: Sequence[ExplainedEpisode]) -> Topic:
    """Return the first episodes, and how many more there are."""
    if not found:
        return Topic("No faults detected")
    lines = []
    for episode, _, words in found[:MAX_EPISODES]:
        lasted = "at the end" if episode.end is None else f"for {duration_text(episode.end - episode.start)}"
        suspected = f" Most likely: {words}." if words else ""
        lines.append(f"{episode.cause}, {lasted}: {episode.text}.{suspected}")
    if len(found) > MAX_EPISODES:
        lines.append(f"and {len(found) - MAX_EPISODES} more; --json has all")
    return Topic(f"{len(found)} episode(s); docs/alarms.md describes each cause", tuple(lines))
