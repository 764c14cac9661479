"""Isolate the single fault that best explains the innovations since an episode began.

A fault of size θ (a constant offset, or a drift of a sensor per second) moves the whitened innovations by θ Δν, as a
refold with that nudge shows. Against the observed innovations ν,

    θ̂ = Σ Δνᵀν / Σ ΔνᵀΔν,   log Λ = ½ (Σ Δνᵀν)² / Σ ΔνᵀΔν

are its most likely size and its log-likelihood ratio against no fault. θ is the error of the twin's number: the excess
of a sensor or an input, or by how much the twin's parameter is too large. The parameter without this error must lie in
its range.

The residual of the best fault, φ = Σ (ν - θ̂ Δν)² / n, is 1 if nothing else is wrong. Where it is larger, the model is
not exact either, and log Λ / φ takes its place (quasi-likelihood). Faults are reported together with their odds, the
exponentials of that, if these are close; and none, if the best explains only a small part of the excess Σ ν² - n.

Sources: Willsky & Jones (1976), doi:10.1109/TAC.1976.1101146, the generalised likelihood ratio of additive faults;
McCullagh & Nelder (1989), Generalized Linear Models, chapter 9, for the division by φ.
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
from ..detectors import detector_of
from .responses import (
    DELAY,
    DRIFT,
    INPUT_SCALE,
    KINDS,
    PARAMETER,
    PRIOR,
    SCALE,
    SWAP,
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
MIN_EXCHANGED = 0.5  # Share of an exchange below which it is none
MIN_NATS = 5.0  # Nats below which a fault explains nothing
RARER_NATS = 3.0  # log of how much rarer faults are that are no constants
EXCESS_SIGMAS = 6.0  # Standard deviations of Σ ν² from which on something needs to be explained
MIN_EXPLAINED = 0.2  # Share of Σ ν² - n below which the best fault is no explanation
ISOLATED_TOO = ("correlated", "narrow", "diverged")  # Causes that leave open who is at fault, beside `Detector.isolate`

NO_EXPLANATION = "none of the sensors, inputs and parameters alone"


def isolates(cause: str) -> bool:
    """Return whether the episodes of a cause leave open who is at fault."""
    return detector_of(cause).isolate or cause in ISOLATED_TOO


class Suspect(NamedTuple):
    """A fault that may be the cause: its most likely size with its standard deviation, and log Λ / φ against no fault.

    explained: share of Σ ν² - n that it explains, at most 1.
    """

    nudge: Nudge
    size: float
    deviation: float
    gain: float
    explained: float = 1.0


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
    first = int(np.searchsorted(log.events.t, round(since * 1e9)))
    cut = log.copy()
    cut.n = min(log.n, first + MAX_EVENTS)
    if first >= cut.n or reason_against(model, cut):
        return []
    begun = _start(estimator, model, tuning, cut, base, first)
    if begun is None:
        return []
    seen = np.nan_to_num(begun.track.whitened)
    kinds = (*KINDS, DRIFT, SCALE, INPUT_SCALE, DELAY, SWAP, PRIOR)
    nudges = nudges_of(model, tuning, begun.log, kinds, begun.track)
    found, left = [], float(np.sum(seen**2))
    count = int(np.isfinite(begun.track.whitened).sum())
    # What chance adds to χ² of so many degrees of freedom needs no explanation.
    excess = left - count if left - count > EXCESS_SIGMAS * np.sqrt(2.0 * count) else 0.0
    for nudge, response in zip(nudges, each(begun.respond, nudges, executor), strict=True):
        moved = np.nan_to_num(response.whitened)
        power = float(np.sum(moved**2))
        if power > 0.0:
            low, high = (-nudge.high, -nudge.low) if nudge.kind == PARAMETER else (nudge.low, nudge.high)
            size = float(np.clip(np.sum(moved * seen) / power, low, high))
            gain = float(size * np.sum(moved * seen) - 0.5 * size**2 * power)
            gain -= 0.0 if nudge.kind in KINDS else RARER_NATS
            found.append(Suspect(nudge, size, power**-0.5, gain))
    checked = each(lambda suspect: _refolded(begun, suspect), found, executor)
    best = max((suspect.gain for suspect in checked), default=0.0)
    spread = max(1.0, (left - 2.0 * best) / max(1, count))
    weighed = [
        suspect._replace(
            gain=suspect.gain / spread, explained=min(1.0, 2.0 * suspect.gain / excess) if excess > 0.0 else 1.0
        )
        for suspect in checked
    ]
    return sorted(weighed, key=lambda suspect: -suspect.gain)


def _refolded(begun: Start, suspect: Suspect) -> Suspect:
    """Return a suspected parameter or delay with the log-likelihood that a fold without it gains, if that is less.

    θ̂ is linear in the derivative; a change by many times the value, as of a short lag, is not, nor a delay of more than
    a period. Sensors that are exchanged are so entirely.
    """
    nudge, size = suspect.nudge, suspect.size
    if nudge.kind == SWAP and size < MIN_EXCHANGED:
        return suspect._replace(gain=0.0)
    linear = {PARAMETER: MAX_LINEAR_SIZE * abs(nudge.value), DELAY: nudge.scale}.get(nudge.kind, np.inf)
    if suspect.gain < MIN_NATS or abs(size) <= linear:
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
    """Return the most likely fault and those that explain as much; none if no single fault explains enough.

    Offset, drift, scale and delay of one sensor count as one fault, the most likely of them.
    """
    if not found or found[0].gain < MIN_NATS or found[0].explained < MIN_EXPLAINED:
        return ()
    alike: dict[tuple[str, str], Suspect] = {}
    for suspect in found:
        if found[0].gain - suspect.gain < EQUAL_NATS:
            alike.setdefault(suspect.nudge.target, suspect)
    return tuple(alike.values())


def odds(alike: Sequence[Suspect]) -> tuple[float, ...]:
    """Return the probabilities of faults of which one is the cause, equally likely before."""
    weights = np.exp([suspect.gain - alike[0].gain for suspect in alike]) if alike else np.zeros(0)
    return tuple((weights / weights.sum()).tolist())


def in_words(found: Sequence[Suspect], most: int = 3) -> str:
    """Describe the most likely faults, at most `most` of them, with their odds; "" if nothing needs to be explained."""
    alike = likeliest(found)
    if not alike:
        return NO_EXPLANATION if found and found[0].explained < MIN_EXPLAINED else ""
    shares = [f" ({100.0 * share:.0f} %)" if len(alike) > 1 else "" for share in odds(alike)]
    words = [_words(one.nudge, one.size) + share for one, share in zip(alike[:most], shares, strict=False)]
    return " or ".join(words) + (f" or {len(alike) - most} more" if len(alike) > most else "")


def _words(nudge: Nudge, size: float) -> str:
    if nudge.kind == PRIOR:
        return f"the estimate of {nudge.name} when it began, {size:+.3g} {nudge.unit}".rstrip()
    if nudge.kind != PARAMETER:
        return nudge.in_words(size)
    return f"{nudge.name} too {'large' if size > 0.0 else 'small'} by {nudge.size_text(abs(size))}"
