"""Isolate the single fault that best explains the innovations since an episode began.

A fault of size θ (a constant offset, or a drift of a sensor per second) moves the whitened innovations by θ Δν, as a
refold with that nudge shows. Against the observed innovations ν,

    θ̂ = Σ Δνᵀν / Σ ΔνᵀΔν,   log Λ = ½ (Σ Δνᵀν)² / Σ ΔνᵀΔν

are its most likely size and its log-likelihood ratio against no fault. Indistinguishable faults have the same log Λ and
are named together. θ is the error of the twin's number: what a sensor or an input reads too much, or by how much the
twin's parameter is too large. The parameter without this error must lie in its range.

Source: Willsky & Jones (1976), doi:10.1109/TAC.1976.1101146, the generalised likelihood ratio of additive faults.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...fold import Fold
from ...log import Log
from ...model.state_space import StateSpaceModel
from ...snapshots import Base
from ...tuning import Tuning
from .responses import (
    DRIFT,
    KINDS,
    PARAMETER,
    SENSOR,
    Nudge,
    Start,
    astray,
    each,
    nudges_of,
    reason_against,
    stand_in,
)

MAX_EVENTS = 4000  # Events since the beginning of an episode that are refolded at most
EQUAL_NATS = 3.0  # Nats within which two faults explain equally much
MAX_LINEAR_SIZE = 0.1  # Share of a parameter's value up to which its effect is taken as linear
MIN_NATS = 5.0  # Nats below which a fault explains nothing


class Suspect(NamedTuple):
    """A fault that may be the cause: its most likely size with its standard deviation, and log Λ against no fault."""

    nudge: Nudge
    size: float
    deviation: float
    gain: float


def suspects(
    estimator: str,
    model: StateSpaceModel,
    tuning: Tuning,
    log: Log,
    since: float,
    *,
    base: Base | None = None,
    executor: Executor | str | None = "threads",
) -> list[Suspect]:
    """Return the faults that may explain the innovations since a time, the most likely first.

    Args:
        estimator: That ran.
        model: The model.
        tuning: That ran.
        log: The folded log; not changed.
        since: Beginning of the episode, s.
        base: Where the log's fold starts, if not at the prior.
        executor: See `sensitivity`.

    Returns:
        Every sensor row, input and parameter by log Λ; none where nudges do not apply (see `sensitivity`), or where a
        filter that would stand in was lost before that time.
    """
    first = int(np.searchsorted(log.t[: log.n], round(since * 1e9)))
    cut = log.copy()
    cut.n = min(log.n, first + MAX_EVENTS)
    if first >= cut.n or reason_against(model, cut):
        return []
    begun = _start(estimator, model, tuning, cut, base, first)
    if begun is None:
        return []
    seen = np.nan_to_num(begun.track.whitened)
    nudges = nudges_of(model, tuning, begun.log, (*KINDS, DRIFT))
    found = []
    for nudge, response in zip(nudges, each(begun.respond, nudges, executor), strict=True):
        moved = np.nan_to_num(response.whitened)
        power = float(np.sum(moved**2))
        if power > 0.0:
            low, high = (-nudge.high, -nudge.low) if nudge.kind == PARAMETER else (nudge.low, nudge.high)
            size = float(np.clip(np.sum(moved * seen) / power, low, high))
            gain = float(size * np.sum(moved * seen) - 0.5 * size**2 * power)
            found.append(Suspect(nudge, size, power**-0.5, gain))
    checked = each(lambda suspect: _refolded(begun, suspect), found, executor)
    return sorted(checked, key=lambda suspect: -suspect.gain)


def _refolded(begun: Start, suspect: Suspect) -> Suspect:
    """Return a suspected parameter with the log-likelihood that a fold without its error gains, if that is less.

    θ̂ is linear in the derivative; a change by many times the value, as of a short lag, is not.
    """
    nudge, size = suspect.nudge, suspect.size
    if nudge.kind != PARAMETER or suspect.gain < MIN_NATS or abs(size) <= MAX_LINEAR_SIZE * abs(nudge.value):
        return suspect
    before, after = (np.nansum(track.log_likelihood) for track in (begun.track, begun.with_fault(nudge, -size)))
    gain = float(after - before)
    return suspect._replace(gain=min(suspect.gain, gain) if np.isfinite(gain) else 0.0)


def _start(
    estimator: str, model: StateSpaceModel, tuning: Tuning, log: Log, base: Base | None, first: int
) -> Start | None:
    """Fold from event `first` on with the gate open: rejected measurements are the most informative."""
    name, note = stand_in(estimator, model)
    own = tuning.with_options({}) if name != estimator else tuning
    fold = Fold(name, model, own, log, base=base)
    fold.advance(first)
    if first and astray(estimator, name, fold.track.select(slice(0, first))):
        return None
    still = log.copy()
    still.drop_front(first)
    return Start.of(name, replace(own, gate=None), still, fold.base_here(), first, note)


def likeliest(found: Sequence[Suspect]) -> tuple[Suspect, ...]:
    """Return the most likely fault and those that explain as much; none if no single fault explains anything.

    Offset and drift of one sensor count as one fault, the more likely of the two.
    """
    if not found or found[0].gain < MIN_NATS:
        return ()
    alike: dict[tuple[str, str], Suspect] = {}
    for suspect in found:
        if found[0].gain - suspect.gain < EQUAL_NATS:
            kind = SENSOR if suspect.nudge.kind == DRIFT else suspect.nudge.kind
            alike.setdefault((kind, suspect.nudge.name), suspect)
    return tuple(alike.values())


def in_words(found: Sequence[Suspect], most: int = 3) -> str:
    """Describe the most likely faults, at most `most` of them."""
    return " or ".join(_words(suspect.nudge, suspect.size) for suspect in likeliest(found)[:most])


def _words(nudge: Nudge, size: float) -> str:
    if nudge.kind != PARAMETER:
        return nudge.in_words(size)
    return f"{nudge.name} too {'large' if size > 0.0 else 'small'} by {nudge.size_text(abs(size))}"
