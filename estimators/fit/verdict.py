"""Whether a fit is proposed: what was held out decides, not what it was fitted to."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .aims import CRPS, ERROR, LIKELIHOOD, WITNESSES, Aim
from .judge import Part, Prediction, Worth, gain

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
