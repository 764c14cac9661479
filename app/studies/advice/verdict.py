"""From the claims to a recommendation: the simplest estimator whose assumptions the recorded data pass.

    small enough for a covariance? -no-> ensemble, localised and inflated
      linear? -yes-> Kalman filter; of a time-invariant asset with regular readings in its steady-state form
        several peaks? -yes-> particles, Rao-Blackwellised where part of the model is linear
          curved over the spread? -no-> EKF, -yes-> square-root UKF
            heavy tails? -yes-> the same, with Student's t

Whether the readings see every state at all is asked where there is one peak; whether the result is consistent and fast
enough, at the end.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from estimators.errors import NisusError
from estimators.fit.objective import ALONE
from estimators.registry import find_entry, unfit

from .claim import NO, UNTOLD, YES, Claim
from .consistent import consistent
from .cost import affordable
from .curvature import curvature
from .ensemble import PREFERRED, sweep
from .lasting import lasting
from .linear import STEADY, linear, steady
from .measured import Measured
from .observed import observed
from .shape import several
from .size import small
from .tails import heavy, with_weights
from .words import digits

STATEMENTS = {
    ("size", NO): "the state is too large for a covariance",
    ("observed", NO): "no filter can recover what the readings do not tell of",
    ("linear", YES): "f and h are linear",
    ("linear", NO): "f or h is not linear",
    ("linear", UNTOLD): "whether f and h are linear could not be measured",
    ("steady", YES): "nothing varies in time, and readings come regularly",
    ("steady", NO): "one fixed gain will not do",
    ("steady", UNTOLD): "whether one gain would do could not be measured",
    ("peaks", YES): "the posterior has several peaks",
    ("peaks", NO): "the posterior has one peak",
    ("peaks", UNTOLD): "nothing tells of several peaks",
    ("curvature", YES): "they curve over the spread of the estimate",
    ("curvature", NO): "they are nearly straight over the spread of the estimate",
    ("curvature", UNTOLD): "their curvature could not be measured",
    ("tails", YES): "the innovations are heavy-tailed",
}
"""What the answers that decide say."""


@dataclass
class Advice:
    """A recommendation: filter and options, the claims in the order in which they were asked, and which decided.

    `because` are the keys of the claims that led to this filter and not to the one before it in the tree. `remedies`
    are what to do beside choosing it; `sections` entries of the YAML, by key, that say which errors last.
    """

    estimator: str = ""
    options: dict[str, float] = field(default_factory=dict)
    claims: list[Claim] = field(default_factory=list)
    because: tuple[str, ...] = ()
    sections: Mapping[str, dict[str, object]] = field(default_factory=dict)

    def claim(self, key: str) -> Claim | None:
        """The claim of that key, if it was asked."""
        return next((claim for claim in self.claims if claim.key == key), None)

    @property
    def title(self) -> str:
        """The filter's own."""
        return find_entry(self.estimator).title

    @property
    def reasons(self) -> list[str]:
        """What decided, each with its figure and what that was compared with."""
        found = []
        for claim in (claim for claim in self.claims if claim.key in self.because):
            text = STATEMENTS[claim.key, claim.answer]
            if claim.figure is not None and claim.threshold is not None:
                text += f": {digits(claim.figure)} {claim.of}, limit {digits(claim.threshold)}"
            found.append(text)
        return found

    @property
    def remedies(self) -> list[str]:
        """What to do beside."""
        return [claim.remedy for claim in self.claims if claim.remedy]


def advise(measured: Measured) -> Advice:
    """Ask the questions of the tree, and recommend.

    Raises:
        NisusError: If no filter applies, or none runs.
    """
    told = Advice()
    size = _ask(told, small(measured))
    if size.answer == NO:
        _of_ensemble(told, measured)
    else:
        _of_small(told, measured)
    _consistency(told, measured, ensemble=size.answer == NO)
    _ask(told, affordable(measured, told.estimator, told.options))
    return told


def _consistency(told: Advice, measured: Measured, *, ensemble: bool) -> None:
    """Whether the result bears out; where its innovations follow one another, whether noise that lasts explains it."""
    claim = consistent(measured, told.estimator, told.options)
    _ask(told, claim)
    # A filter that draws is too slow to be fitted here, and has no likelihood that is smooth.
    if claim.answer != NO or ensemble or find_entry(told.estimator).family in ALONE:
        return
    found = lasting(measured, told.estimator, told.options)
    if found is not None:
        told.sections = found[1].sections
        _ask(told, found[0])


def _ask(told: Advice, claim: Claim) -> Claim:
    told.claims.append(claim)
    return claim


def _choose(told: Advice, measured: Measured, names: tuple[str, ...], because: tuple[str, ...]) -> None:
    """The first of some filters that applies, with the options that the twin has for it."""
    reasons = []
    for name in names:
        against = unfit(find_entry(name), measured.twin.model)
        if against is None:
            told.estimator, told.because = name, (*told.because, *because)
            return
        reasons.append(f"{name}: {against}")
    raise NisusError(f"{measured.twin.name}: no filter of {', '.join(names)} applies; {'; '.join(reasons)}")


def _of_ensemble(told: Advice, measured: Measured) -> None:
    _choose(told, measured, PREFERRED, ("size",))
    found, told.options = sweep(measured, told.estimator)
    told.claims += found


def _of_small(told: Advice, measured: Measured) -> None:
    straight = _ask(told, linear(measured)).answer
    if _ask(told, several(measured)).answer == YES:
        # What the readings tell is asked of a filter with one peak, so it is not asked here.
        _choose(told, measured, ("rbpf", "pf"), ("linear", "peaks"))
        return
    if _ask(told, observed(measured)).answer == NO:
        told.because = ("observed",)
    if straight == YES and measured.twin.model.linear:
        _of_linear(told, measured)
    elif straight == YES:
        _choose(told, measured, ("ekf", "sr-ukf", "ukf", "enkf"), ("linear", "peaks"))
    elif _ask(told, curvature(measured)).answer == YES:
        _choose(told, measured, ("sr-ukf", "ukf", "enkf"), ("linear", "peaks", "curvature"))
    else:
        _choose(told, measured, ("ekf", "sr-ukf", "enkf"), ("linear", "peaks", "curvature"))
    _of_tails(told, measured)


def _of_linear(told: Advice, measured: Measured) -> None:
    if told.because:
        # What nothing tells of has no steady state.
        _choose(told, measured, ("kf",), ("linear",))
        return
    claim, period = steady(measured)
    if _ask(told, claim).answer == YES:
        _choose(told, measured, (STEADY,), ("linear", "steady"))
        told.options = {"period": period}
    else:
        _choose(told, measured, ("kf",), ("linear", "steady"))


def _of_tails(told: Advice, measured: Measured) -> None:
    """Student's t where tails are heavy."""
    claim, dof = heavy(measured, told.estimator, told.options)
    if _ask(told, claim).answer == YES:
        name, weighted = with_weights(told.estimator, dof)
        if weighted:
            told.estimator, told.options, told.because = name, weighted, (*told.because, "tails")
