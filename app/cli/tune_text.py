"""What a fit found, as sections of tables."""

from __future__ import annotations

import numpy as np

from estimators.diagnostics.sensitivity.responses import digits
from estimators.fit.fit import Fitted, Line
from estimators.fit.judge import Part, Prediction, Worth

from ..live.runs.runs_json import correlated
from ..present.result import Topic
from ..twin.twin import Twin

ALONE = "left alone: the data cannot tell"
BOUND = "only a bound: the data cannot tell it from none"
EDGE = "at the edge of its range: the best may lie beyond"
TEMPERED = (
    "Of what the fitted blocks say {:.2g} is believed: with more of it the blocks held out are predicted no better."
)


def sections(twin: Twin, fitted: Fitted) -> list[Topic]:
    """From top to bottom."""
    held_out = _held_out(fitted)
    return [_entries(twin, fitted), _scores(fitted), *([held_out] if held_out.rows else []), _verdict(fitted)]


def heading(twin: Twin, fitted: Fitted) -> str:
    """Comment above the lines of a tuning that is proposed: what it is, and why it is proposed."""
    gained = f"{_gained(fitted)} on blocks held out"
    return f"# Fitted by `nisus tune {twin.name}`: {gained}.\n# These sections stand in place of the twin's own.\n"


def _number(value: float) -> str:
    return digits(value) if np.isfinite(value) else "-"


def _pair(before: float, after: float, form: str, unit: str = "") -> str:
    """A figure before and after; a dash where nothing told it."""
    old, new = (f"{value:{form}}" if np.isfinite(value) else "-" for value in (before, after))
    return f"{old} -> {new}{unit if np.isfinite(after) else ''}"


def _entries(twin: Twin, fitted: Fitted) -> Topic:
    rows = [
        (
            line.key,
            _number(line.before),
            _number(line.after),
            "" if line.alone else f"{_number(line.low)} to {_number(line.high)}",
            line.unit,
            _remark(line),
        )
        for line in fitted.lines
    ]
    rows += [(item.key, "", "", "", "", f"not fitted: {item.reason}") for item in fitted.skipped]
    pairs = [
        f"{pair['entries'][0]} with {pair['entries'][1]} ({pair['correlation']:+.2f})" for pair in correlated(fitted)
    ]
    said = [f"Hardly told apart: {', '.join(pairs)}."] if pairs else []
    said += [f"{name} was stuck: {n:,} of its readings were left out." for name, n in fitted.left_out.items()]
    head = ("entry", "before", "after", "95 % interval", "unit", "")
    return Topic(f"{twin.name}: {fitted.estimator}, {fitted.folds} folds", tuple(said), head, tuple(rows))


def _remark(line: Line) -> str:
    if line.alone:
        return ALONE
    if line.edge and line.told:
        return EDGE
    return BOUND if not line.told else ""


def _scores(fitted: Fitted) -> Topic:
    def row(what: str, before: Part, after: Part) -> tuple[str, ...]:
        return (
            what,
            f"{before.n:,}",
            _pair(before.log_density, after.log_density, ".4f"),
            _pair(before.nis, after.nis, ".3f"),
            _pair(100 * before.coverage, 100 * after.coverage, ".1f", " %"),
        )

    rows = [row("fitted", fitted.before.fitted, fitted.after.fitted)]
    if fitted.before.held_out.n:
        rows.append(row("held out", fitted.before.held_out, fitted.after.held_out))
    head = ("blocks", "readings", "log density of a reading, nats", "NIS / dof", "in the 95 % band")
    return Topic("Predictions of the next reading, before and after", (), head, tuple(rows))


def _held_out(fitted: Fitted) -> Topic:
    rows: list[tuple[str, ...]] = []
    for kind, group in (("sensor", "sensors"), ("never used", "withheld"), ("truth", "states")):
        rows += _rows(kind, group, fitted.before, fitted.after)
    head = ("", "", "unit", "RMS", "in the 95 % band", "RMS, blocks held out", "in the 95 % band")
    return Topic("Sensors held out in turn, and what is known to be true, before and after", (), head, tuple(rows))


def _rows(kind: str, group: str, before: Worth, after: Worth) -> list[tuple[str, ...]]:
    def pair(name: str, worths: tuple[Part, Part]) -> tuple[str, str]:
        old, new = (getattr(part, group).get(name) for part in worths)
        if not isinstance(old, Prediction) or not isinstance(new, Prediction):
            return "", ""
        return f"{_number(old.rms)} -> {_number(new.rms)}", _pair(100 * old.coverage, 100 * new.coverage, ".0f", " %")

    parts = (before.fitted, after.fitted), (before.held_out, after.held_out)
    names = dict.fromkeys(name for part in parts for name in getattr(part[0], group))
    units = {name: item.unit for part in parts for name, item in getattr(part[0], group).items()}
    return [(kind, name, units[name], *pair(name, parts[0]), *pair(name, parts[1])) for name in names]


def _gained(fitted: Fitted) -> str:
    return f"{fitted.verdict.gain:+.3g} ± {fitted.verdict.error:.2g} nats {fitted.verdict.each}"


def _verdict(fitted: Fitted) -> Topic:
    verdict = fitted.verdict
    if verdict.proposed:
        said = f"Proposed: {_gained(fitted)} on the blocks held out."
        return Topic("Verdict", (said, *([] if fitted.power == 1.0 else [TEMPERED.format(fitted.power)])))
    return Topic("Verdict", ("Not proposed:", *verdict.reasons))
