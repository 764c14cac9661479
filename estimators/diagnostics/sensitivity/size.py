"""Which folds can be nudged at all."""

from __future__ import annotations

from ...log import READING, Log
from ...model.state_space import StateSpaceModel

MOST_STATES = 64
"""States beyond which a model is too large to be folded again for each of its nudges."""


def reason_against(model: StateSpaceModel, log: Log) -> str:
    """Why sensitivities are not computed, in words, or nothing."""
    if model.grid is not None or model.nx > MOST_STATES:
        return f"{model.name} has {model.nx:,} states; sensitivities are computed up to {MOST_STATES}"
    if not (log.kind[: log.n] == READING).any():
        return "the log has no reading, so nothing can be seen"
    return ""
