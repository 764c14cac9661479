"""A fit, from the recordings to the proposal.

The maximum is found on blocks of time; entries that the data do not identify go back to their start, and the others are
fitted again without them; intervals follow from the curvature. Then held-out blocks and sensors choose the power of the
likelihood (judge.py), and decide whether the result is proposed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..errors import EstimatorError
from ..log import READING
from ..registry import find_estimator
from ..tuning import Tuning
from .aims import LIKELIHOOD, WITNESSES, aim_of, sensors_in_turn
from .entries import DIGITS, PLAIN_DIGITS, Setting, Skipped, TuningEntry, entries_of, with_values
from .judge import POWERS, FitVerdict, Tempered, Worth, tempered
from .objective import SEARCH_FOLDS, SHARES, FitProgress, Go, Objective, maximise, polished, search
from .recording import BLOCKS, Recording, held_out_rows, until_last_fitted, without_queries, without_stuck
from .uncertainty import (
    NEARBY,
    LikelihoodCurvature,
    ParameterWidths,
    Z,
    curvature,
    curvature_points,
    intervals,
    parameter_widths,
)

MAX_DEVIATION = 0.25
"""Deviation of an identified entry, in deviations of its weak prior: for a variance a factor of 3 in its standard
deviation."""

MAX_COST = 2.0  # Nats that it may cost to reset an entry that is not identified: the size of chance
EXPECTED_STEPS = 15  # Steps of a maximisation, for the estimate of the folds to come
MAX_RESETS = 3  # Times that entries are reset and the others fitted again


class EntryFit(NamedTuple):
    """One entry of the result, in its unit: before and after, and the 95 % interval.

    told: whether the data identify it; an entry that they do not identify is reset where that costs nothing (`alone`),
    and then `after` is `before`; otherwise only a bound is known. deviation: of the estimate, on the logarithm if
    `log`. profile: whether the interval is by profile likelihood. edge: whether the value is at an end of its range, so
    that the optimum may lie beyond. pull: deviations by which the weak prior has moved the value; 0 without it.
    """

    key: str
    unit: str
    before: float
    after: float
    low: float = np.nan
    high: float = np.nan
    deviation: float = np.nan
    log: bool = False
    told: bool = False
    alone: bool = True
    profile: bool = False
    edge: bool = False
    pull: float = 0.0


@dataclass(frozen=True)
class Fitted:
    """Result of a fit.

    `setting` is the fitted tuning (and the prior, where it was fitted); `verdict` is whether it is proposed. `power` is
    that of the likelihood. correlation (k, k) is that of the estimates of `lines`, NaN for reset entries. `left_out` is
    the number of readings of stuck sensors, by sensor. `stopped` is whether the search was ended early. `widths` is the
    uncertainty of the parameters to consider, None if there are none. `penalised` is whether the objective has the weak
    prior; without it the values are those of maximum likelihood.
    """

    estimator: str
    setting: Setting
    lines: tuple[EntryFit, ...]
    skipped: tuple[Skipped, ...]
    left_out: Mapping[str, int]
    correlation: np.ndarray
    before: Worth
    after: Worth
    verdict: FitVerdict
    power: float
    folds: int
    stopped: bool = False
    widths: ParameterWidths | None = None
    penalised: bool = True

    @property
    def proposed(self) -> bool:
        """Whether it is better on the held-out data."""
        return self.verdict.proposed


def fit(
    estimator: str,
    tuning: Tuning,
    recordings: Sequence[Recording],
    *,
    wanted: Sequence[str] = ("Q", "R"),
    bounds: Mapping[str, tuple[float, float]] | None = None,
    blocks: int = BLOCKS,
    aim: str = LIKELIHOOD,
    predict: Sequence[str] = (),
    considered: Mapping[str, float] | None = None,
    penalised: bool = True,
    go: Go = lambda folds: True,
    progress: FitProgress | None = None,
    executor: Executor | str | None = "threads",
) -> Fitted:
    """Fit entries of a tuning to recordings.

    Args:
        estimator: The filter.
        tuning: Start of the fit, and centre of the weak prior.
        recordings: They must not grow meanwhile (give copies).
        wanted: Keys and groups, see `entries_of`.
        bounds: Range by key.
        blocks: Blocks of time per recording; every third is held out. 0 holds none out: then nothing is judged, and
            nothing proposed.
        aim: Aim of the fit, see aims.py.
        predict: Sensors to hold out, for an aim that does; each in turn by default.
        considered: Parameters whose uncertainty is wanted, with their deviations without data, in their units.
        penalised: Whether the objective has the weak prior. Without it all entries are fitted, also those that the data
            do not identify, with the full weight of the likelihood.
        go: Called from any thread with the number of folds done since; returns whether to continue.
        progress: Kept up to date from any thread; with its `stop` set, the best point so far is judged and returned.
        executor: Where recordings are folded: "threads", an Executor, or None to fold one after the other. The results
            are the same bits. An Executor of processes needs a model that can be pickled.

    Raises:
        Cancelled: If `go` returns False.
        ConfigError: If none of the wanted entries can be fitted.
        EstimatorError: As `Fold`; if there is nothing to fit to, or no such aim.
    """
    progress = progress or FitProgress()
    progress.folds, progress.gain, progress.values, progress.judging = 0, 0.0, {}, False

    def count(done: int) -> bool:
        progress.folds += done
        progress.expected = max(progress.expected, progress.folds)
        return go(done)

    for item in recordings:
        if not np.any(item.log.events.kind == READING):
            raise EstimatorError("a recording has no reading; there is nothing to fit to")
    references = aim == WITNESSES
    entries, skipped = entries_of(
        estimator, tuning, [item.log for item in recordings], wanted, bounds, references=references
    )
    whole: list[Recording] = []
    lean: list[Recording] = []
    left_out = Counter[str]()
    for item in recordings:
        log, repetitions = without_stuck(estimator, tuning, item.log, item.base)
        left_out.update(repetitions)
        for into, part in ((whole, log), (lean, without_queries(log, truth=references))):
            into.append(item._replace(log=part, held_out=held_out_rows(part, blocks)))
    lean = [until_last_fitted(item) for item in lean]
    aimed = aim_of(aim, estimator, Setting(tuning, None), lean, tuple(predict))
    objective = Objective(
        estimator,
        tuning,
        tuple(entries),
        tuple(lean),
        aim=aimed,
        go=count,
        progress=progress,
        penalised=penalised,
        executor=executor,
    )
    alone = find_estimator(estimator, tuning.model).samples
    settings = 2 if not blocks else 1 + len(POWERS)
    # Sensors are held out in turn at the start and at the chosen point, unless they are the aim.
    in_turn = (settings if aimed.sensors else 2) * len(sensors_in_turn(Setting(tuning, None), whole))
    judging = len(recordings) * (settings + in_turn)

    def expect(k: int, steps: int) -> None:
        """Estimate the folds to come: a maximisation over k entries, its curvature, and the judgement."""
        points = SEARCH_FOLDS * k // 2 if alone else (steps + 1) * (k + 1) + steps * len(SHARES)
        points = points if steps else 0
        progress.expect(len(recordings) * aimed.folds * (points + curvature_points(k)) + judging)

    expect(len(entries), EXPECTED_STEPS)
    kept, x, value = objective, *(search if alone else maximise)(objective, objective.start)
    expect(x.size, 0)
    shape = curvature(kept, x)
    if not penalised and not alone:
        x = polished(kept, x, shape.cov)
        value, shape = kept.value(x), curvature(kept, x)
    identified = _identified(kept, shape)
    for _ in range(MAX_RESETS if penalised else 0):
        if progress.stop:
            break
        reset = _resettable(kept, x, value, shape, identified)
        if not reset:
            break
        if len(reset) == x.size:
            kept, x = kept.pinned(reset, kept.start), np.zeros(0)
            break
        progress.values |= {kept.entries[i].key: (kept.entries[i].start, kept.entries[i].start) for i in reset}
        start = np.where(np.isin(np.arange(x.size), reset), kept.start, x)
        kept = kept.pinned(reset, start)
        expect(len(kept.entries), EXPECTED_STEPS // 3)
        rest = np.delete(np.arange(start.size), reset)
        # With some entries at fixed values, the curvature of the others is a part of the one before.
        H = np.linalg.inv(shape.cov)[np.ix_(rest, rest)]
        before, x = x[rest], start[rest]
        x, value = search(kept, x) if alone else maximise(kept, x, H)
        near = np.all(np.abs(x - before) < NEARBY * shape.deviation[rest])
        expect(x.size, 0)
        shape = curvature(kept, x, H if near else None)
        identified = _identified(kept, shape)

    def setting_at(point: np.ndarray) -> Setting:
        digits = DIGITS if penalised else PLAIN_DIGITS
        values = [item.written(value, digits) for item, value in zip(kept.entries, point.tolist(), strict=True)]
        return with_values(tuning, kept.entries, values)

    progress.expect(judging)
    progress.judging = True
    powers = POWERS if blocks and x.size and penalised else (1.0,)
    chosen = tempered(kept, x, shape, setting_at, whole, powers=powers)
    progress.expect(0)
    widths = None
    if considered:
        progress.expect(len(recordings) * (1 + 2 * len(considered)))
        widths = parameter_widths(
            estimator, setting_at(chosen.x), lean, considered, aim=aimed, go=count, executor=executor
        )
    lines, correlation = _lines(objective.entries, kept, x, value, shape, chosen, identified)
    return Fitted(
        estimator=estimator,
        setting=setting_at(chosen.x),
        lines=lines,
        skipped=tuple(skipped),
        left_out=dict(left_out),
        correlation=correlation,
        before=chosen.before,
        after=chosen.after,
        verdict=chosen.verdict,
        power=chosen.power,
        folds=progress.folds,
        stopped=progress.stop,
        widths=widths,
        penalised=penalised,
    )


def _identified(objective: Objective, shape: LikelihoodCurvature) -> np.ndarray:
    return shape.deviation <= MAX_DEVIATION * np.array([item.deviation for item in objective.entries])


def _resettable(
    objective: Objective, x: np.ndarray, value: float, shape: LikelihoodCurvature, identified: np.ndarray
) -> list[int]:
    """Return the entries that are not identified and can go back to their start at no cost."""
    loose = np.flatnonzero(~identified)
    if not loose.size:
        return []
    # All others follow along the parabola; the terms there give an upper bound of the cost.
    points = [objective.within(x + (objective.start[i] - x[i]) * shape.lines[i]) for i in loose]
    found = objective.all_terms(points)
    costs = [value - terms.sum() + objective.penalty(p) for p, terms in zip(points, found, strict=True)]
    return [int(i) for i, cost in zip(loose, costs, strict=True) if cost <= MAX_COST * shape.widened[i] ** 2]


def _at_edge(item: TuningEntry, x: float) -> bool:
    value = item.outward(x)
    near = 1e-6 * (item.high - item.low) if np.isfinite(item.high - item.low) and not item.log else 1e-6 * abs(value)
    return bool(value - item.low <= near or item.high - value <= near)


def _lines(
    entries: Sequence[TuningEntry], kept: Objective, x: np.ndarray, value: float, shape: LikelihoodCurvature,
    chosen: Tempered, identified: np.ndarray,
) -> tuple[tuple[EntryFit, ...], np.ndarray]:  # fmt: skip
    """Return the lines of all entries, reset ones too, in their order, and the correlations."""
    ends, profiled, deviation = np.zeros((0, 2)), np.zeros(x.size, bool), shape.deviation
    if chosen.power < 1.0:
        # Of the tempered likelihood, which discounts correlated errors.
        deviation = np.sqrt(np.diag(chosen.cov))
    elif x.size and not kept.progress.stop:
        ends, profiled = intervals(kept, x, value, shape)
    if x.size and not ends.size:
        ends = np.stack([kept.within(chosen.x + side * Z * deviation) for side in (-1.0, 1.0)], axis=1)
    place = {item.key: i for i, item in enumerate(kept.entries)} if x.size else {}
    # To first order, from the maximum of the likelihood on the parabola.
    pulls = -shape.cov @ (kept.precision * (chosen.x - kept.start)) if x.size and kept.penalised else np.zeros(x.size)
    digits = DIGITS if kept.penalised else PLAIN_DIGITS
    lines = []
    for item in entries:
        if item.key not in place:
            lines.append(EntryFit(item.key, item.unit, item.start, item.start, log=item.log))
            continue
        i = place[item.key]
        at = float(chosen.x[i])
        lines.append(
            EntryFit(
                key=item.key,
                unit=item.unit,
                before=item.start,
                after=item.written(at, digits),
                low=item.outward(float(ends[i, 0])),
                high=item.outward(float(ends[i, 1])),
                deviation=float(deviation[i]),
                log=item.log,
                told=bool(identified[i]),
                alone=False,
                profile=bool(profiled[i]),
                edge=_at_edge(item, at),
                pull=float(pulls[i] / deviation[i]),
            )
        )
    correlation = np.full((len(lines), len(lines)), np.nan)
    rows = [k for k, item in enumerate(entries) if item.key in place]
    if rows:
        correlation[np.ix_(rows, rows)] = shape.correlation
    return tuple(lines), correlation
