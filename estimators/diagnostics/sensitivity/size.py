"""Which folds can be nudged at all, and how much of them."""

from __future__ import annotations

from ...log import READING, Log
from ...model.state_space import StateSpaceModel

MOST_STATES = 64
"""States beyond which a model is too large to be folded again for each of its nudges."""

MOST_EVENTS = 20_000
"""Events that are folded again; of a longer log the last."""

MOST_NUMBERS = 32_000_000
"""Numbers that the responses may take together."""

MOST_WORK = 2_000_000_000
"""Events times nudges times nx³, as a covariance costs: some ten seconds."""


def reason_against(model: StateSpaceModel, log: Log) -> str:
    """Why sensitivities are not computed, in words, or nothing."""
    if model.grid is not None or model.nx > MOST_STATES:
        return f"{model.name} has {model.nx:,} states; sensitivities are computed up to {MOST_STATES}"
    if not (log.kind[: log.n] == READING).any():
        return "the log has no reading, so nothing can be seen"
    return ""


def most_events(model: StateSpaceModel, nudges: int) -> int:
    """How many events are folded again for so many nudges, by what that takes."""
    numbers = nudges * (2 * model.ny + 2 * len(model.shown))
    return max(1, min(MOST_EVENTS, MOST_NUMBERS // numbers, MOST_WORK // (nudges * model.nx**3)))
