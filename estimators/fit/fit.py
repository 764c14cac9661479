"""A fit, from the recordings to what is proposed of it.

The maximum is sought on blocks of time; entries that the data cannot tell go back to what the twin says, and the others
are fitted again without them; intervals follow from the curvature there. Then blocks and sensors that were held out
decide how much of it is believed (tempered.py), and whether the result is better than what was: if not, that is what is
said, and nothing is proposed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..errors import EstimatorError
from ..log import READING
from ..registry import find_estimator
from ..tuning import Tuning
from .aims import LIKELIHOOD, WITNESSES, aim_of
from .entries import Entry, Setting, Skipped, entries_of, with_values
from .judge import Verdict, Worth, worths
from .objective import ALONE, Go, Objective, maximise, search
from .recording import BLOCKS, Recording, held_out_rows, without_queries, without_stuck
from .tempered import POWERS, Tempered, tempered
from .uncertainty import Curvature, Z, curvature, intervals

TOLD = 0.25
"""Share of the weak belief's deviation, up to which an entry counts as told by the data: of a variance a factor of 3 in
its standard deviation."""

CHEAP = 2.0
"""Nats that it may cost to leave an entry alone which the data cannot tell: what chance gives."""

PASSES = 3
"""Times that entries are left alone and the others fitted again."""


class Line(NamedTuple):
    """One entry of the result, in its unit: before and after, and the 95 % interval.

    `told` is whether the data tell it; an entry that they do not tell is left alone where that costs nothing, and then
    `after` is `before`; else only a bound of it is known. `deviation` is that of the estimate, on the logarithm where
    `log` is true. `profile` says that the interval is by profile likelihood, `edge` that the value is at an end of the
    range that was searched: the best may lie beyond.
    """

    key: str
    unit: str
    before: float
    after: float
    low: float
    high: float
    deviation: float
    log: bool
    told: bool
    alone: bool
    profile: bool
    edge: bool = False


@dataclass(frozen=True)
class Fitted:
    """What came of a fit.

    `setting` is the tuning that was found (and the prior, where that was fitted); whether it is proposed says
    `verdict`. `power` is that of the likelihood at which it was found. correlation (k, k) is that of the estimates of
    `lines`, NaN for those left alone. `left_out` are readings of sensors that were stuck, by sensor (stuck.py).
    """

    estimator: str
    setting: Setting
    lines: tuple[Line, ...]
    skipped: tuple[Skipped, ...]
    left_out: Mapping[str, int]
    correlation: np.ndarray
    before: Worth
    after: Worth
    verdict: Verdict
    power: float
    folds: int

    @property
    def proposed(self) -> bool:
        """Whether it won on what was held out."""
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
    go: Go = lambda folds: True,
) -> Fitted:
    """Fit entries of a tuning to recordings.

    Args:
        estimator: The filter.
        tuning: Where it starts, and what is weakly believed.
        recordings: They must not grow meanwhile (give copies).
        wanted: Keys and groups, see `entries_of`.
        bounds: Least and greatest value by key.
        blocks: Blocks of time into which each recording is cut; every third is held out. 0 holds none out: then nothing
            is judged, and nothing proposed.
        aim: What is maximised, see aims.py.
        predict: Of an aim that holds sensors out, which; each in turn without.
        go: Called from any thread with the number of folds that were done more; says whether to go on.

    Raises:
        Cancelled: If `go` says so.
        ConfigError: If nothing that was asked for can be fitted.
        EstimatorError: As `Fold`; if there is nothing to fit to, or no such aim.
    """
    done = [0]

    def count(folds: int) -> bool:
        done[0] += folds
        return go(folds)

    for given in recordings:
        if not np.any(given.log.kind[: given.log.n] == READING):
            raise EstimatorError("a recording has no reading; there is nothing to fit to")
    logs = [given.log for given in recordings]
    entries, skipped = entries_of(estimator, tuning, logs, wanted, bounds, witnesses=aim == WITNESSES)
    recordings, left_out = _unstuck(tuning, recordings)
    whole = [_held_out(item, blocks) for item in recordings]
    lean = [
        _held_out(item._replace(log=without_queries(item.log, truth=aim == WITNESSES)), blocks) for item in recordings
    ]
    aimed = aim_of(aim, estimator, Setting(tuning, None), lean, tuple(predict))
    objective = Objective(estimator, tuning, tuple(entries), tuple(lean), aim=aimed, go=count)
    draws = find_estimator(estimator, tuning.model).family in ALONE
    best = search if draws else maximise
    x, value = best(objective, objective.start)
    shape = curvature(objective, x)
    kept = objective
    told = _told(kept, shape)
    alone: list[Entry] = []
    for _ in range(PASSES):
        leave = _leave(kept, x, value, shape, told)
        if not leave:
            break
        alone += [kept.entries[i] for i in leave]
        if len(leave) == x.size:
            x = np.zeros(0)
            kept = kept.pinned(leave, kept.start)
            break
        start = np.where(np.isin(np.arange(x.size), leave), kept.start, x)
        kept = kept.pinned(leave, start)
        x, value = best(kept, np.delete(start, leave))
        shape = curvature(kept, x)
        told = _told(kept, shape)

    def setting_at(point: np.ndarray) -> Setting:
        values = [item.written(value) for item, value in zip(kept.entries, point.tolist(), strict=True)]
        return with_values(tuning, kept.entries, values)

    believed = tempered(
        kept, x, shape, setting_at, lambda settings: worths(estimator, settings, whole, count, aimed), aim=aimed,
        powers=POWERS if blocks and x.size else (1.0,),
    )  # fmt: skip
    lines, correlation = _lines(objective, kept, x, value, shape, believed, told, alone)
    return Fitted(
        estimator=estimator,
        setting=setting_at(believed.x),
        lines=lines,
        skipped=tuple(skipped),
        left_out=left_out,
        correlation=correlation,
        before=believed.before,
        after=believed.after,
        verdict=believed.verdict,
        power=believed.power,
        folds=done[0],
    )


def _unstuck(tuning: Tuning, recordings: Sequence[Recording]) -> tuple[list[Recording], dict[str, int]]:
    found, left_out = [], Counter[str]()
    for given in recordings:
        log, repetitions = without_stuck(tuning, given.log)
        found.append(given._replace(log=log))
        left_out.update(repetitions)
    return found, dict(left_out)


def _held_out(recording: Recording, blocks: int) -> Recording:
    return recording._replace(held_out=held_out_rows(recording.log, blocks))


def _told(objective: Objective, shape: Curvature) -> np.ndarray:
    deviations = np.array([item.deviation for item in objective.entries])
    found: np.ndarray = shape.deviation <= TOLD * deviations
    return found


def _leave(objective: Objective, x: np.ndarray, value: float, shape: Curvature, told: np.ndarray) -> list[int]:
    """Entries that the data do not tell, and which can go back to where they were at no cost."""
    loose = np.flatnonzero(~told)
    if not loose.size:
        return []
    low, high = np.array(objective.limits).T
    # All others follow, as far as the parabola holds; then what it costs is known for certain, from above.
    lines = shape.cov / np.diag(shape.cov)[:, None]
    points = [np.clip(x + (objective.start[i] - x[i]) * lines[i], low, high) for i in loose]
    found = objective.all_terms(points)
    costs = [value - terms.sum() + objective.penalty(p) for p, terms in zip(points, found, strict=True)]
    return [int(i) for i, cost in zip(loose, costs, strict=True) if cost <= CHEAP * shape.widened[i] ** 2]


def _at_edge(item: Entry, x: float) -> bool:
    value = item.outward(x)
    near = 1e-6 * (item.high - item.low) if np.isfinite(item.high - item.low) and not item.log else 1e-6 * abs(value)
    return bool(value - item.low <= near or item.high - value <= near)


def _lines(
    whole: Objective, kept: Objective, x: np.ndarray, value: float, shape: Curvature, believed: Tempered,
    told: np.ndarray, alone: Sequence[Entry],
) -> tuple[tuple[Line, ...], np.ndarray]:  # fmt: skip
    """Of every entry that was asked for, those left alone too, in the order in which they were; and correlations."""
    deviation = shape.deviation
    ends, profiled = np.zeros((0, 2)), np.zeros(0, bool)
    if believed.power < 1.0:
        # Of what is believed, in which correlated errors count for what they are.
        deviation = np.sqrt(np.diag(believed.cov))
        low, high = np.array(kept.limits).T
        ends = np.clip(
            np.stack([believed.x - Z * deviation, believed.x + Z * deviation], axis=1), low[:, None], high[:, None]
        )
        profiled = np.zeros(x.size, bool)
    elif x.size:
        ends, profiled = intervals(kept, x, value, shape)
    place = {item.key: i for i, item in enumerate(kept.entries)} if x.size else {}
    lines = []
    for item in whole.entries:
        i = place.get(item.key)
        line = Line(
            key=item.key,
            unit=item.unit,
            before=item.start,
            after=item.start,
            low=np.nan,
            high=np.nan,
            deviation=np.nan,
            log=item.log,
            told=False,
            alone=True,
            profile=False,
        )
        if i is not None:
            line = line._replace(
                after=item.written(float(believed.x[i])),
                low=item.outward(float(ends[i, 0])),
                high=item.outward(float(ends[i, 1])),
                deviation=float(deviation[i]),
                told=bool(told[i]),
                alone=False,
                profile=bool(profiled[i]),
                edge=_at_edge(item, float(believed.x[i])),
            )
        lines.append(line)
    correlation = np.full((len(lines), len(lines)), np.nan)
    rows = [k for k, item in enumerate(whole.entries) if item.key in place]
    if rows:
        order = [place[whole.entries[k].key] for k in rows]
        correlation[np.ix_(rows, rows)] = shape.correlation[np.ix_(order, order)]
    return tuple(lines), correlation
