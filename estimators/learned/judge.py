"""Whether a learned correction is better than the physics alone, on blocks of time from which it did not learn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..fit.judge import Part, Prediction, gain
from ..fit.verdict import COVERED, NARROWER, SURE, WORSE
from .train import Trained, drift
from .windows import Windows


class OnWindows(NamedTuple):
    """What the physics and the correction leave over in some windows, (k,) by corrected state.

    `rms` of the rates and the `drift` that they add up to, first of the physics; `known` is the mean share of its
    variance that the correction knows away there.
    """

    n: int
    rms: tuple[np.ndarray, np.ndarray]
    drift: tuple[np.ndarray, np.ndarray]
    known: float


def known(trained: Trained, given: Windows) -> float:
    """The mean share of its variance that a correction knows away in some windows."""
    return 1.0 - float(np.mean(trained.correction.share(given.features)))


def on_windows(given: Windows, rest: np.ndarray, share: float) -> OnWindows:
    """Of windows in which the correction left `rest` (M, k), and knows that share."""
    both = given.rates, rest
    first, second = (np.sqrt(np.mean(rates**2, axis=0)) for rates in both)
    return OnWindows(len(rest), (first, second), (drift(given, both[0]), drift(given, both[1])), share)


def on_held_out(trained: Trained, given: Windows) -> OnWindows:
    """Of windows that took no part in its training."""
    return on_windows(given, given.rates - trained.correction.mean(given.features), known(trained, given))


def against(physics: Sequence[Part], corrected: Part, states: Sequence[str]) -> tuple[str, ...]:
    """What speaks against a correction, on blocks that were held out; nothing if it is better.

    Args:
        physics: The physics alone, first as the twin has it: the correction must be better under any of the tunings.
        corrected: With the correction.
        states: Those that are corrected: judged by their truth where it is known, else by the next reading.
    """
    reasons: list[str] = []
    for one in physics:
        judged = [name for name in states if name in one.states]
        for name in judged:
            old, new = one.states[name], corrected.states[name]
            mean, error = gain(-old.scores, -new.scores)
            if not mean > SURE * error:
                reasons.append(
                    f"the true {name}, held out, is not estimated better: CRPS {new.crps:.3g} {new.unit} after "
                    f"{old.crps:.3g}, by {mean:+.2g} ± {error:.2g}"
                )
            if one is physics[0]:
                reasons += _narrower(f"the true {name}", old, new)
        if not judged:
            mean, error = gain(one.terms, corrected.terms)
            if not mean > SURE * error:
                reasons.append(
                    f"the blocks held out are not predicted better: {mean:+.3g} ± {error:.2g} nats a reading"
                )
        for kind, olds, news in (("sensor", one.sensors, corrected.sensors), ("true", one.states, corrected.states)):
            for name, old in olds.items():
                if kind == "true" and name in judged:
                    continue
                mean, error = gain(old.scores, news[name].scores)
                if mean > WORSE * old.crps and mean > SURE * error:
                    reasons.append(f"{kind} {name} is predicted worse: CRPS {news[name].crps:.3g} after {old.crps:.3g}")
    return tuple(dict.fromkeys(reasons))


def _narrower(what: str, old: Prediction, new: Prediction) -> list[str]:
    if new.coverage < COVERED and new.coverage < old.coverage - NARROWER:
        return [f"{what} leaves its band: {100 * new.coverage:.0f} % inside after {100 * old.coverage:.0f} %"]
    return []
