"""An advice as one page of text, and as JSON."""

from __future__ import annotations

import textwrap

from estimators.log import READING, Log

from ..present.result import WIDTH
from ..studies.advice.lines import lasting_lines, lines
from ..studies.advice.verdict import Advice
from ..twin.twin import Twin


def as_text(twin: Twin, log: Log, told: Advice) -> list[str]:
    """The page: the recommendation, the claims in the order of the tree, the lines, and what else to do."""
    seconds = float(log.t[log.n - 1] - log.t[0]) * 1e-9
    readings = int((log.kind[: log.n] == READING).sum())
    same = " (it has it)" if told.estimator == twin.estimator else f" (it has {twin.estimator})"
    page = [
        f"{twin.name}: {twin.title}",
        f"  measured on {seconds:.4g} s of its log, {readings:,} readings",
        "",
        f"Use {told.estimator}, {_lower(told.title)}{same}",
        *(line for reason in told.reasons for line in _wrapped(f"because {reason}", 2)),
        "",
        "Why",
    ]
    for claim in told.claims:
        mark = " *" if claim.key in told.because else ""
        page.append(f"  {claim.question} {claim.answer}{mark}")
        page += _wrapped(claim.reason, 6)
    page += [
        "",
        f"Lines for {twin.path.name}",
        *(f"  {line}" for line in (lines(told) + lasting_lines(told)).splitlines()),
    ]
    if told.remedies:
        page += ["", "What else to do", *(line for text in told.remedies for line in _wrapped(f"- {text}", 2))]
    return page


def _lower(title: str) -> str:
    """A title within a sentence."""
    return title if title.startswith(("Kalman", "Rao")) else title[0].lower() + title[1:]


def _wrapped(text: str, indent: int) -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent=" " * indent, subsequent_indent=" " * (indent + 2))
