"""Can the readings see every state? A filter cannot recover what they cannot."""

from __future__ import annotations

import numpy as np

from .claim import NO, UNTOLD, YES, Claim
from .measured import Measured
from .words import digits, percent

LEFT = 0.9
"""Share of the prior deviation; a state that keeps more was not observed."""


def observed(measured: Measured) -> Claim:
    """By the Gramian along the log: the state that keeps most of its prior deviation after all readings."""
    question = "Do the readings tell of every state?"
    of = "of its prior deviation left to the state that is seen least"
    found, model = measured.gramian, measured.twin.model
    if found.whole is None:
        return Claim("observed", question, UNTOLD, None, LEFT, of, found.reason)
    if found.whole.beyond:
        return Claim("observed", question, UNTOLD, None, LEFT, of, found.note)
    free = np.flatnonzero(model.prior_std > 0.0)
    if not free.size:
        return Claim("observed", question, YES, 0.0, LEFT, of, "every state is certain at first")
    left = found.whole.deviation[free]
    worst, most = model.state_names[int(free[np.argmax(left)])], float(left.max())
    unseen = [model.state_names[int(k)] for k in free[left > LEFT]]
    reason = (
        f"after all readings {worst} keeps {percent(most)} of its prior deviation, the most of all states; the Gramian "
        f"has rank {found.whole.rank} of {model.nx} and conditioning {digits(found.whole.conditioning)}"
    )
    if not unseen:
        return Claim("observed", question, YES, most, LEFT, of, reason)
    names = ", ".join(unseen)
    remedy = (
        f"no filter recovers {names}: add a sensor that it moves, or take it out of the state; until then it keeps its "
        f"prior and drifts, and its band is all that is known of it"
    )
    return Claim("observed", question, NO, most, LEFT, of, f"{reason}; not seen: {names}", remedy)
