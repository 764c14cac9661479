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

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from config.tunings import SPREADS
from config.yaml_files import as_flow, as_section, parse, with_section, with_values
from estimators.diagnostics.calibration import LIMITS
from estimators.errors import ConfigError, NisusError
from estimators.log import Log
from estimators.registry import find_entry, unfit

from ...format_time import counted, format_time
from ...result import JsonObject, plain
from ...twin.twin import Twin
from .coloured_noise import COLOURED, lasting
from .measured import NO, UNTOLD, YES, Claim, Exclusion, Measured, digits, repeat_lines, repeats_of
from .questions import (
    PREFERRED,
    QUESTIONS,
    STEADY,
    affordable,
    consistent,
    curvature,
    heavy,
    linear,
    observed,
    several,
    small,
    steady,
    sweep,
    with_weights,
)

FINDINGS = {
    ("size", YES): "The state is small enough for a full covariance",
    ("size", NO): "Too many states for a full covariance; use an ensemble filter",
    ("observed", YES): "All states are observable",
    ("observed", NO): "Some states are not observable; no filter can recover them",
    ("observed", UNTOLD): "Observability could not be measured",
    ("linear", YES): "The model is linear; a Kalman filter is exact",
    ("linear", NO): "The model is nonlinear",
    ("linear", UNTOLD): "Linearity could not be measured",
    ("steady", YES): "Time-invariant with regular measurements; a fixed gain is sufficient",
    ("steady", NO): "The gain varies with time; a fixed gain is not sufficient",
    ("steady", UNTOLD): "Too few measurements to judge a fixed gain",
    ("peaks", YES): "Several hypotheses at once; use a particle filter",
    ("peaks", NO): "One hypothesis at a time; no particle filter is needed",
    ("peaks", UNTOLD): "No evidence of several hypotheses",
    ("curvature", YES): "Nonlinear within the uncertainty of the estimate; UKF is more accurate than EKF",
    ("curvature", NO): "Effectively linear; EKF is sufficient",
    ("curvature", UNTOLD): "The effect of the nonlinearity could not be measured",
    ("tails", YES): "The measurements have outliers; robust weights are recommended",
    ("tails", NO): "No robust weights are needed",
    ("tails", UNTOLD): "Too few measurements to judge outliers",
    ("consistent", YES): "Bands are right within a quarter, and innovations are hardly correlated",
    ("consistent", NO): "Bands are off by more than a quarter, or innovations are correlated; noise or model need work",
    ("consistent", UNTOLD): "Too few measurements to judge consistency",
    ("lasting", YES): "Coloured noise explains the correlated innovations",
    ("lasting", NO): "Coloured noise does not explain the correlated innovations",
    ("lasting", UNTOLD): "Coloured noise could not be tested",
    ("cost", YES): "Fast enough for this measurement rate",
    ("cost", NO): "Too slow for this measurement rate",
}
"""Answer of each question, in a sentence for engineers; the figures are details."""

QUESTION_TEXTS = {question.key: question.text for question in (*QUESTIONS, COLOURED)}

UNITS_OF_WORK = {
    "size": 0.1, "linear": 4.0, "peaks": 8.0, "observed": 3.0, "steady": 2.0, "curvature": 2.0, "tails": 1.0,
    "consistent": 1.0, "lasting": 10.0, "cost": 0.1,
}  # fmt: skip
"""Folds that each question takes, about, for the remaining time."""


def finding(claim: Claim) -> str:
    """Return the answer of a claim in a sentence."""
    if claim.key == "linear" and claim.answer == NO and claim.figure is not None and claim.figure <= LIMITS.bias:
        return "Nonlinear, with a negligible effect on the estimate"
    if claim.figure is not None and claim.key in ("radius", "inflation", "members"):
        return f"Use {claim.key} {digits(claim.figure)}"
    return FINDINGS.get((claim.key, claim.answer), f"{claim.question} {claim.answer}")


def details(claim: Claim) -> str:
    """Return the figures of a claim, its limit and the arithmetic."""
    figures = ""
    if claim.figure is not None and claim.threshold is not None:
        figures = f"{digits(claim.figure)} {claim.of}, limit {digits(claim.threshold)}; "
    return figures + claim.reason


def exclusion_text(item: Exclusion) -> str:
    """Return what was left out: `yoke, 12.0 s to 31.5 s: stuck (195 readings)`."""
    at = [format_time(round(seconds * 1e9)) for seconds in (item.start, item.end)]
    return f"{item.row}, {at[0]} to {at[1]}: {item.cause} ({counted(item.readings, 'reading')})"


@dataclass
class Advice:
    """A recommendation: filter and options, the claims in the order in which they were asked, and which decided.

    `because` are the keys of the claims that led to this filter and not to the one before it in the tree. `remedies`
    are other actions; `sections` are entries of the YAML, by key, that declare coloured noise; `excluded` are the
    readings in faults, on which nothing is based. `repeats` are lines on sensors whose measurements are repeats.
    """

    estimator: str = ""
    options: dict[str, float] = field(default_factory=dict)
    claims: list[Claim] = field(default_factory=list)
    because: tuple[str, ...] = ()
    sections: Mapping[str, dict[str, object]] = field(default_factory=dict)
    excluded: tuple[Exclusion, ...] = ()
    repeats: tuple[str, ...] = ()

    def claim(self, key: str) -> Claim | None:
        """The claim of that key, if it was asked."""
        return next((claim for claim in self.claims if claim.key == key), None)

    @property
    def title(self) -> str:
        """Title of the filter."""
        return find_entry(self.estimator).title

    @property
    def reasons(self) -> list[str]:
        """Deciding answers, in words."""
        return [finding(claim) for claim in self.claims if claim.key in self.because]

    @property
    def remedies(self) -> list[str]:
        """Other actions."""
        return [*self.repeats, *(claim.remedy for claim in self.claims if claim.remedy)]


def advise(measured: Measured) -> Advice:
    """Ask the questions of the tree, and recommend.

    Raises:
        NisusError: If no filter applies, or none runs.
    """
    repeats = repeat_lines(repeats_of(measured.twin.model, measured.log))
    told = Advice(excluded=measured.excluded, repeats=tuple(repeats))
    measured.progress.expected = sum(UNITS_OF_WORK.values())
    size = _ask(told, measured, "size", small)
    if size.answer == NO:
        _of_ensemble(told, measured)
    else:
        _of_small(told, measured)
    _consistency(told, measured, ensemble=size.answer == NO)
    _ask(told, measured, "cost", lambda _: affordable(measured, told.estimator, told.options))
    # The claims hold for the filter with the options that the twin has for it.
    told.options = {**measured.twin.options_of(told.estimator), **told.options}
    return told


def _consistency(told: Advice, measured: Measured, *, ensemble: bool) -> None:
    """Check the chosen filter for consistency; if its innovations are correlated, try coloured noise."""
    claim = _ask(told, measured, "consistent", lambda _: consistent(measured, told.estimator, told.options))
    # A filter that draws is too slow to be fitted here, and has no likelihood that is smooth.
    if claim.answer != NO or ensemble or find_entry(told.estimator).samples:
        return
    with _asking(measured, "lasting"):
        found = lasting(measured, told.estimator, told.options)
    if found is not None:
        told.sections = found[1].sections
        told.claims.append(found[0])


@contextmanager
def _asking(measured: Measured, key: str) -> Iterator[None]:
    """Report that a question is being answered, and then that it and all before it are over."""
    progress = measured.progress
    progress.check()
    progress.question = QUESTION_TEXTS[key]
    yield
    keys = list(UNITS_OF_WORK)
    progress.done = sum(UNITS_OF_WORK[before] for before in keys[: keys.index(key) + 1])


def _ask(told: Advice, measured: Measured, key: str, answer: Callable[[Measured], Claim]) -> Claim:
    with _asking(measured, key):
        claim = answer(measured)
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
    straight = _ask(told, measured, "linear", linear).answer
    if _ask(told, measured, "peaks", several).answer == YES:
        # What the readings tell is asked of a filter with one peak, so it is not asked here.
        _choose(told, measured, ("rbpf", "pf"), ("linear", "peaks"))
        return
    if _ask(told, measured, "observed", observed).answer == NO:
        told.because = ("observed",)
    if straight == YES and measured.twin.model.linear:
        _of_linear(told, measured)
    elif straight == YES:
        _choose(told, measured, ("ekf", "sr-ukf", "ukf", "enkf"), ("linear", "peaks"))
    elif _ask(told, measured, "curvature", curvature).answer == YES:
        _choose(told, measured, ("sr-ukf", "ukf", "enkf"), ("linear", "peaks", "curvature"))
    else:
        _choose(told, measured, ("ekf", "sr-ukf", "enkf"), ("linear", "peaks", "curvature"))
    _of_tails(told, measured)


def _of_linear(told: Advice, measured: Measured) -> None:
    if told.because:
        # What nothing tells of has no steady state.
        _choose(told, measured, ("kf",), ("linear",))
        return
    with _asking(measured, "steady"):
        claim, period = steady(measured)
    told.claims.append(claim)
    if claim.answer == YES:
        _choose(told, measured, (STEADY,), ("linear", "steady"))
        told.options = {"period": period}
    else:
        _choose(told, measured, ("kf",), ("linear", "steady"))


def _of_tails(told: Advice, measured: Measured) -> None:
    """Student's t where tails are heavy."""
    with _asking(measured, "tails"):
        claim, dof = heavy(measured, told.estimator, told.options)
    told.claims.append(claim)
    if claim.answer == YES:
        name, weighted = with_weights(told.estimator, dof)
        if weighted:
            told.estimator, told.options, told.because = name, weighted, (*told.because, "tails")


def advice_json(twin: Twin, log: Log, told: Advice) -> JsonObject:
    """`estimator`, `options`, `because`, `claims` with figure and threshold, `lines`, `remedies`."""
    return {
        "twin": twin.name,
        "has": twin.estimator,
        "seconds": log.events.seconds,
        "estimator": told.estimator,
        "options": told.options,
        "because": list(told.because),
        "reasons": told.reasons,
        "claims": [{**plain(claim), "finding": finding(claim), "details": details(claim)} for claim in told.claims],
        "excluded": [{**plain(item), "text": exclusion_text(item)} for item in told.excluded],
        "lines": lines(told) + lasting_lines(told),
        "remedies": told.remedies,
    }


def lines(advice: Advice) -> str:
    """The section `estimator`, with the options that were found."""
    why = ", ".join(advice.because)
    if not advice.options:
        return f"estimator: {advice.estimator}  # nisus advise: by {why}\n"
    options = ", ".join(f"{name}: {_word(advice, name, value)}" for name, value in advice.options.items())
    return (
        f"estimator:                       # nisus advise: by {why}\n"
        f"  name: {advice.estimator}\n  options: {{{options}}}\n"
    )


def _word(advice: Advice, name: str, value: float) -> str:
    """A value as YAML reads it: of a choice its word."""
    option = next(option for option in find_entry(advice.estimator).options if option.name == name)
    return str(option.choices[round(value)]) if option.choices else f"{value:.4g}"


def lasting_lines(advice: Advice) -> str:
    """Return the entries of `noise` and `sensors` that declare coloured noise; empty if there is none."""
    found: dict[str, dict[str, object]] = {}
    for key, entry in advice.sections.items():
        group, _, name = key.partition(".")
        found.setdefault(group, {})[name] = entry
    return "".join(f"{line}\n" for group, entries in found.items() for line in as_section(group, entries))


def with_entry(text: str, key: str, entry: Mapping[str, object]) -> str:
    """A YAML's text in which `GROUP.NAME` says this too; what else it said stays, its comments do not.

    Raises:
        ConfigError: If an alias shares what it says with another key.
    """
    group, _, name = key.partition(".")
    known = parse(text, "the YAML")[0].get(group)
    if not known:
        return with_section(text, group, "".join(f"{line}\n" for line in as_section(group, {name: entry})))
    own = known.get(name) or {}
    # Its white noise is another once part of it lasts.
    merged = {**{word: value for word, value in own.items() if word not in SPREADS}, **entry}
    changed, missing = with_values(text, {(group, name): merged})
    if missing:
        raise ConfigError(f"{key}: an alias shares it with another key; put {name}: {as_flow(merged)} in by hand")
    return changed


def changed(text: str, section: str, entries: Mapping[str, Mapping[str, object]] | None = None) -> str:
    """Return a YAML text with the section `estimator` replaced or added, and with other entries."""
    text = with_section(text, "estimator", section)
    for key, entry in (entries or {}).items():
        text = with_entry(text, key, entry)
    return text
