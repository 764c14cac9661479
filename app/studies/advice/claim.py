"""One claim of an advice: a question of the tree, the figure that answers it, and the arithmetic in words."""

from __future__ import annotations

from dataclasses import dataclass

YES, NO, UNTOLD = "yes", "no", "not told"


@dataclass(frozen=True)
class Claim:
    """A question and its answer.

    `figure` is the number that decides, `threshold` what it is compared with, and `of` says what both are, with the
    unit; the figure is None where nothing could be measured, and `answer` is then by the model's own word or "not
    told". `reason` has the arithmetic; `remedy` is what to do beside the choice of a filter, if anything.
    """

    key: str
    question: str
    answer: str
    figure: float | None
    threshold: float | None
    of: str
    reason: str
    remedy: str = ""
