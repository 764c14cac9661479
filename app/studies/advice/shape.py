"""The shape of the posterior: several peaks, for which particles are there, or one?"""

from __future__ import annotations

from estimators.diagnostics.sensitivity.posterior import MOST_STATES, OFTEN

from .claim import NO, UNTOLD, YES, Claim
from .measured import Measured
from .words import percent

QUESTION = "Does the posterior have several peaks?"
OF = "of the looks at the cloud of particles with several peaks"


def several(measured: Measured) -> Claim:
    """By the share of the looks at two clouds of particles that show more than one peak in both."""
    model = measured.twin.model
    if model.linear and model.jump is None and not any(sensor.log_likelihood for sensor in model.sensors):
        reason = "f and h are linear and the noise is Gaussian, so the posterior is Gaussian"
        return Claim("peaks", QUESTION, NO, 0.0, OFTEN, OF, reason)
    if model.nx > MOST_STATES:
        reason = (
            f"{model.nx:,} states: the particles that are needed grow exponentially with them, so a cloud cannot tell "
            f"beyond {MOST_STATES}"
        )
        return Claim("peaks", QUESTION, UNTOLD, None, OFTEN, OF, reason)
    found = measured.peaks
    if found.reason:
        return Claim("peaks", QUESTION, UNTOLD, None, OFTEN, OF, found.reason)
    reason = f"{percent(found.several)} of {found.looks} looks at clouds of {found.estimator} over {found.over:.4g} s"
    if found.recoveries:
        reason += f"; the cloud lost the asset {found.recoveries} time(s), so its shape says little"
        return Claim("peaks", QUESTION, UNTOLD, found.several, OFTEN, OF, reason)
    reason += f", at most {found.most} peak{'s' if found.most > 1 else ''} at once"
    return Claim("peaks", QUESTION, YES if found.several > OFTEN else NO, found.several, OFTEN, OF, reason)
