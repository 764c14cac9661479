"""What the filter that is chosen takes of a processor at the asset's rate."""

from __future__ import annotations

from estimators.registry import find_entry

from .claim import NO, YES, Claim
from .measured import Measured
from .size import SHARE
from .words import digits, percent, seconds_text

QUESTION = "Is it fast enough for the asset?"
OF = "of one processor"


def affordable(measured: Measured, estimator: str, options: dict[str, float] | None = None) -> Claim:
    """By its measured time a reading."""
    folded = measured.folded(estimator, options)
    share = folded.seconds * measured.rate
    runs = find_entry(estimator).runs(folded.fold.options, measured.twin.model.nx)
    reason = (
        f"{estimator} took {seconds_text(folded.seconds)} a reading ({digits(runs)} model runs a step); times "
        f"{digits(measured.rate)} readings a second that is {percent(share)} of a processor"
    )
    if share <= SHARE:
        return Claim("cost", QUESTION, YES, share, SHARE, OF, reason)
    remedy = "fewer readings, fewer members, or a simpler filter: time.late and decimation are for the edge"
    return Claim("cost", QUESTION, NO, share, SHARE, OF, reason, remedy)
