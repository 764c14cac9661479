"""What a tuning is worth, on the readings that it was fitted to and on those that were held out.

Four judges, none of which the fit has seen: the density of the readings of blocks held out, the readings of each sensor
in turn predicted by the others, the coverage of the predictions, and, where a recording knows it, the true state. A
prediction that is held out is judged by the continuous ranked probability score, which is proper, in its unit, and not
carried away by a single reading.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..diagnostics.innovations import mean_nis
from ..diagnostics.sensitivity.responses import each
from ..log import READING, TRUTH
from ..model.state_space import StateSpaceModel
from ..registry import find_estimator
from ..track import USED, Track
from .aims import (
    CRPS,
    ERROR,
    LIKELIHOOD,
    WITNESSES,
    Aim,
    Witness,
    crps,
    densities,
    of_sensor,
    sensors_in_turn,
    track_of,
    witnesses,
)
from .entries import Setting
from .objective import ALONE, Cancelled, Go
from .recording import Recording

Z = 1.959963984540054

_Found = dict[str, tuple[str, list[tuple[np.ndarray, np.ndarray]]]]
"""Unit, errors and standard deviations, by name."""

BATCHES = 20
"""Batches of time over which a difference is averaged, to know how much of it is chance."""


class Prediction(NamedTuple):
    """How something that was not used was predicted, n times.

    Root mean square error and mean CRPS are in `unit`, coverage is the share of errors inside the 95 % band; `scores`
    (n,) are the single CRPS.
    """

    unit: str
    n: int
    rms: float
    coverage: float
    crps: float
    scores: np.ndarray


class Part(NamedTuple):
    """What the readings of one part of the recordings say.

    How many they are, mean log density of one, mean NIS a degree of freedom, share of innovations inside their 95 %
    band. `terms` (n,) are the single log densities, `aimed` what readings and truths add to the aim of the fit, if that
    holds no sensor out. `sensors` are those held out in turn, `withheld` the rows of those
    that the twin itself never uses, `states` those whose truth is known, by name.
    """

    n: int
    log_density: float
    nis: float
    coverage: float
    terms: np.ndarray
    aimed: np.ndarray
    sensors: dict[str, Prediction]
    withheld: dict[str, Prediction]
    states: dict[str, Prediction]


class Worth(NamedTuple):
    """The part that was fitted to, and the part that was held out."""

    fitted: Part
    held_out: Part


def worths(
    estimator: str, settings: Sequence[Setting], recordings: Sequence[Recording], go: Go, aim: Aim | None = None
) -> list[Worth]:
    """What each setting is worth.

    Args:
        estimator: Of all.
        settings: Tunings and priors.
        recordings: With the truth, where it is known.
        go: Told of each fold.
        aim: Of the fit; None for the likelihood.

    Raises:
        Cancelled: If `go` says so.
    """
    model = settings[0].tuning.model
    sensors = sensors_in_turn(settings[0], list(recordings))
    jobs = [(setting, record, s) for setting in settings for record in recordings for s in (None, *sensors)]

    def run(job: tuple[Setting, Recording, int | None]) -> Track:
        given, record, s = job
        track = track_of(estimator, given, record, without=s)
        if not go(1):
            raise Cancelled
        return track

    alone = find_estimator(estimator, model).family in ALONE
    tracks = iter(each(run, jobs, None if alone else "threads"))
    found = []
    for setting in settings:
        taken = [(record, [next(tracks) for _ in (None, *sensors)]) for record in recordings]
        fitted, held = (_part(model, setting, sensors, taken, aim or Aim(), wanted) for wanted in (False, True))
        found.append(Worth(fitted, held))
    return found


def gain(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Mean of after less before (n,), and its standard error from batches of time."""
    difference = after - before
    n = difference.size
    if n < 2 * BATCHES:
        return float(difference.mean()) if n else 0.0, float(difference.std() / np.sqrt(max(1, n - 1)))
    means = np.array([batch.mean() for batch in np.array_split(difference, BATCHES)])
    return float(difference.mean()), float(means.std(ddof=1) / np.sqrt(BATCHES))


def _part(
    model: StateSpaceModel, setting: Setting, sensors: list[int], taken: list[tuple[Recording, list[Track]]],
    aim: Aim, held_out: bool,
) -> Part:  # fmt: skip
    terms, aimed, normal, nis = [], [], [], []
    errors, withheld, truths = ({} for _ in range(3))  # type: tuple[_Found, _Found, _Found]
    for record, (track, *others) in taken:
        log = record.log
        wanted = record.held_out == held_out
        kind = log.kind[: log.n]
        reading, told = wanted & (kind == READING), wanted & ((kind == READING) | (kind == TRUTH))
        values = densities(track, setting.tuning.gate)
        terms.append(values[reading])
        aimed.append(aim.told(model, log, track, setting.tuning.gate)[told])
        used = wanted & (track.verdict == USED)
        normal.append((track.innovation[used] / track.innovation_std[used]).ravel())
        nis.append(track.select(wanted))
        for s, other in zip(sensors, others, strict=True):
            for item in of_sensor(model, log, other, s):
                _collect(errors, item, wanted)
        for item in witnesses(model, log, track):
            _collect(truths if item.truth else withheld, item, wanted)
    every, inside = np.concatenate(terms), np.concatenate(normal)
    inside = inside[np.isfinite(inside)]
    weights = [len(track) for track in nis]
    return Part(
        n=every.size,
        log_density=float(every.mean()) if every.size else np.nan,
        nis=_mean_nis(nis, weights, setting.tuning.gate),
        coverage=float(np.mean(np.abs(inside) <= Z)) if inside.size else np.nan,
        terms=every,
        aimed=np.concatenate(aimed),
        sensors=_predictions(errors),
        withheld=_predictions(withheld),
        states=_predictions(truths),
    )


def _mean_nis(tracks: list[Track], weights: list[int], gate: float | None) -> float:
    values = np.array([mean_nis(track, gate) for track in tracks])
    kept = np.isfinite(values)
    return float(np.average(values[kept], weights=np.array(weights)[kept])) if kept.any() else np.nan


def _collect(into: _Found, item: Witness, wanted: np.ndarray) -> None:
    kept = wanted[item.rows]
    if kept.any():
        into.setdefault(item.name, (item.unit, []))[1].append((item.error[kept], item.std[kept]))


def _predictions(found: _Found) -> dict[str, Prediction]:
    return {name: _prediction(unit, pairs) for name, (unit, pairs) in found.items()}


def _prediction(unit: str, pairs: list[tuple[np.ndarray, np.ndarray]]) -> Prediction:
    error, std = (np.concatenate([pair[k] for pair in pairs]) for k in (0, 1))
    scores = crps(error, std)
    return Prediction(
        unit,
        error.size,
        float(np.sqrt(np.mean(error**2))),
        float(np.mean(np.abs(error) <= Z * std)),
        float(scores.mean()),
        scores,
    )


SURE = 2.0
"""Standard errors that a gain must exceed, and a loss before it counts."""

LEAST = 1.0
"""Nats that a fit must bring on all that was held out: with less it is the same tuning in other digits."""

WORSE = 0.05
"""Share by which the score of a held-out prediction may grow before it counts."""

COVERED = 0.9
"""Coverage of a 95 % band from which on it is not too narrow."""

NARROWER = 0.05
"""Coverage that may be lost before it counts, where it is below `COVERED`."""


EACH = {LIKELIHOOD: "a reading", WITNESSES: "a reading or witness"}
"""What a gain in nats is a mean of, by aim."""


class Verdict(NamedTuple):
    """Whether the fit is proposed.

    With the mean gain on the blocks held out, `each` of what that is in nats, its standard error, and the reasons
    against it. `harmless` is whether nothing that was held out is predicted worse, though it may not gain either.
    """

    proposed: bool
    gain: float
    error: float
    reasons: tuple[str, ...]
    each: str = "a reading"
    harmless: bool = False


def verdict(before: Worth, after: Worth, aim: Aim, *, changed: bool = True) -> Verdict:
    """Judge by the part that was held out: what the fit aimed at must be better there, and nothing else worse."""
    one, other = before.held_out, after.held_out
    if not changed:
        few = f": what the recording knows has {aim.independent:.0f} independent errors" if aim.weights else ""
        return Verdict(False, 0.0, 0.0, (f"the data tell none of the entries{few}",))
    if not one.n:
        return Verdict(False, np.nan, np.nan, ("nothing was held out, so nothing judges it",))
    mean, error = _gain(one, other, aim)
    each = EACH.get(aim.kind, "a reading")
    reasons = []
    if not mean > SURE * error:
        unit = "of the score" if aim.kind in (CRPS, ERROR) else f"nats {each}"
        reasons.append(f"it does not predict the blocks held out better: {mean:+.3g} ± {error:.2g} {unit}")
    elif aim.kind in EACH and mean * other.aimed.size < LEAST:
        reasons.append(f"what it gains is next to nothing: {mean * other.aimed.size:.2g} nats in all")
    against = [
        reason
        for kind, olds, news in _judges(one, other)
        for name, old in olds.items()
        if name in news
        for reason in _against(f"{kind} {name}, held out,", old, news[name])
    ]
    reasons += against
    return Verdict(not reasons, mean, error, tuple(reasons), each, not against)


def _judges(one: Part, other: Part) -> list[tuple[str, dict[str, Prediction], dict[str, Prediction]]]:
    """What must not be predicted worse: the witnesses; where there are none, each sensor in turn stands in for them."""
    if one.withheld or one.states:
        return [("sensor", one.withheld, other.withheld), ("true state", one.states, other.states)]
    return [("sensor", one.sensors, other.sensors)]


def _gain(one: Part, other: Part, aim: Aim) -> tuple[float, float]:
    """Of what was aimed at, and its standard error."""
    if aim.kind not in (CRPS, ERROR):
        return gain(one.aimed, other.aimed)
    pairs = [(old.scores / old.crps, other.sensors[name].scores / old.crps) for name, old in one.sensors.items()]
    found = [gain(-old, -new) for old, new in pairs if old.size == new.size]
    if not found:
        return 0.0, 0.0
    means, errors = np.array(found).T
    return float(means.mean()), float(np.sqrt(np.sum(errors**2)) / len(found))


def _against(what: str, old: Prediction, new: Prediction) -> list[str]:
    """What speaks against the new prediction."""
    if old.n != new.n:
        return [f"{what} could not be predicted at {abs(old.n - new.n)} readings"]
    mean, error = gain(old.scores, new.scores)
    found = []
    if mean > WORSE * old.crps and mean > SURE * error:
        unit = f" {new.unit}" if new.unit else ""
        found.append(f"{what} is predicted worse: CRPS {new.crps:.3g}{unit} after {old.crps:.3g}")
    if new.coverage < COVERED and new.coverage < old.coverage - NARROWER:
        found.append(f"{what} leaves its band: {100 * new.coverage:.0f} % inside after {100 * old.coverage:.0f} %")
    return found
