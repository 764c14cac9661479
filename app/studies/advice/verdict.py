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

import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from config.tunings import SPREADS
from config.yaml_files import as_flow, parse, writing
from estimators.errors import ConfigError, NisusError
from estimators.fit.objective import ALONE
from estimators.log import Log
from estimators.registry import find_entry, unfit

from ...present.result import plain
from ...twin.twin import Twin
from .coloured_noise import lasting
from .measured import NO, UNTOLD, YES, Claim, Measured, digits
from .questions import (
    PREFERRED,
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

STATEMENTS = {
    ("size", NO): "the state is too large for a covariance",
    ("observed", NO): "no filter recovers an unobservable state",
    ("linear", YES): "f and h are linear",
    ("linear", NO): "f or h is not linear",
    ("linear", UNTOLD): "whether f and h are linear could not be measured",
    ("steady", YES): "time-invariant, with regular measurements",
    ("steady", NO): "the gain varies with time; a steady-state filter is not enough",
    ("steady", UNTOLD): "whether one gain suffices could not be measured",
    ("peaks", YES): "the posterior has several peaks",
    ("peaks", NO): "the posterior has one peak",
    ("peaks", UNTOLD): "no evidence of several peaks",
    ("curvature", YES): "they curve over the spread of the estimate",
    ("curvature", NO): "they are nearly straight over the spread of the estimate",
    ("curvature", UNTOLD): "their curvature could not be measured",
    ("tails", YES): "the innovations are heavy-tailed",
}
"""Statement of each deciding answer."""


@dataclass
class Advice:
    """A recommendation: filter and options, the claims in the order in which they were asked, and which decided.

    `because` are the keys of the claims that led to this filter and not to the one before it in the tree. `remedies`
    are other actions; `sections` are entries of the YAML, by key, that declare coloured noise.
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
        """Title of the filter."""
        return find_entry(self.estimator).title

    @property
    def reasons(self) -> list[str]:
        """Deciding answers, each with its figure and limit."""
        found = []
        for claim in (claim for claim in self.claims if claim.key in self.because):
            text = STATEMENTS[claim.key, claim.answer]
            if claim.figure is not None and claim.threshold is not None:
                text += f": {digits(claim.figure)} {claim.of}, limit {digits(claim.threshold)}"
            found.append(text)
        return found

    @property
    def remedies(self) -> list[str]:
        """Other actions."""
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
    """Check the chosen filter for consistency; if its innovations are correlated, try coloured noise."""
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


def advice_json(twin: Twin, log: Log, told: Advice) -> dict[str, Any]:
    """`estimator`, `options`, `because`, `claims` with figure and threshold, `lines`, `remedies`."""
    return {
        "twin": twin.name,
        "has": twin.estimator,
        "seconds": float(log.t[log.n - 1] - log.t[0]) * 1e-9,
        "estimator": told.estimator,
        "options": told.options,
        "because": list(told.because),
        "reasons": told.reasons,
        "claims": [plain(claim) for claim in told.claims],
        "lines": lines(told) + lasting_lines(told),
        "remedies": told.remedies,
    }


ESTIMATOR = re.compile(r"^estimator[ \t]*:[^\n]*\n(?:(?:[ \t]*\n)*[ \t]+\S[^\n]*\n)*", re.MULTILINE)
"""The section of the YAML: its line, and the indented ones below."""


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
    found: dict[str, list[str]] = {}
    for key, entry in advice.sections.items():
        group, _, name = key.partition(".")
        found.setdefault(group, []).append(f"  {name}: {as_flow(entry)}\n")
    return "".join(f"{group}:\n{''.join(entries)}" for group, entries in found.items())


def with_entry(text: str, key: str, entry: Mapping[str, Any]) -> str:
    """A YAML's text in which `GROUP.NAME` says this too; what else it said stays, its comments do not.

    Raises:
        ConfigError: If the group is not written with a line for each of its names.
    """
    group, _, name = key.partition(".")
    data = parse(text, "the YAML")[0][group] if re.search(rf"^{group}[ \t]*:", text, re.MULTILINE) else {}
    own = (data or {}).get(name) or {}
    # Its white noise is another once part of it lasts.
    merged = {**{word: value for word, value in own.items() if word not in SPREADS}, **entry}
    line = f"{name}: {as_flow(merged)}\n"
    if not data:
        return f"{text}\n{group}:\n  {line}"
    head = re.search(rf"^{group}[ \t]*:[ \t]*(#[^\n]*)?\n", text, re.MULTILINE)
    if head is None:
        raise ConfigError(f"{group}: is written in one line; put {name}: {as_flow(merged)} in by hand")
    here = re.compile(rf"^([ \t]+)([\"']?){re.escape(name)}\2[ \t]*:[^\n]*\n(?:\1[ \t]+\S[^\n]*\n)*", re.MULTILINE)
    found = here.search(text, head.end()) if name in data else None
    if found is None:
        first = re.compile(r"[ \t]*").match(text, head.end())
        indent = (first.group() if first else "") or "  "
        return text[: head.end()] + indent + line + text[head.end() :]
    return text[: found.start()] + found.group(1) + line + text[found.end() :]


def changed(text: str, section: str, entries: Mapping[str, Mapping[str, Any]] | None = None) -> str:
    """Return a YAML text with the section `estimator` replaced or added, and with other entries."""
    end = "\r\n" if "\r\n" in text else "\n"
    plain = text.replace("\r\n", "\n")
    if plain and not plain.endswith("\n"):
        plain += "\n"
    found, count = ESTIMATOR.subn(lambda _: section, plain, count=1)
    plain = found if count else plain + "\n" + section
    for key, entry in (entries or {}).items():
        plain = with_entry(plain, key, entry)
    return plain.replace("\n", end)


def apply(
    path: Path, section: str, out: Path | None = None, entries: Mapping[str, Mapping[str, Any]] | None = None
) -> Path | None:
    """Write the YAML with that section, and these entries, to `out`, or over itself.

    Returns:
        The copy of the file as it was, beside it; None where `out` was written.

    Raises:
        ConfigError: If it cannot be written.
    """
    with writing(out or path):
        with path.open(encoding="utf-8", newline="") as file:
            text = changed(file.read(), section, entries)
        if out is None:
            kept = _free(path)
            shutil.copy2(path, kept)
        else:
            kept = None
        (out or path).write_text(text, encoding="utf-8", newline="")
    return kept


def _free(path: Path) -> Path:
    """A name beside a file that no other has: pump.1.yaml.bak."""
    k = 1
    while (copy := path.with_name(f"{path.name}.{k}.bak")).exists():
        k += 1
    return copy
