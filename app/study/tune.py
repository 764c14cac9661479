"""Results of a fit as topics: entries, scores, held-out sensors, verdict; and of dual estimation by windows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from config.tunings import named
from estimators.diagnostics.sensitivity.responses import digits
from estimators.fit.aims import WITNESSES
from estimators.fit.dual import WindowFit, against, shift
from estimators.fit.entries import PLAIN_DIGITS
from estimators.fit.fit import EntryFit, Fitted
from estimators.fit.judge import PartScore, PredictionScore, Worth
from estimators.fit.objective import FitProgress
from estimators.registry import find_estimator

from ..result import JsonObject, Topic, finite_text
from ..twin.twin import Twin
from .fit_json import correlated, fit_json

MOVES_SHOWN = 2  # entries in a line of progress
MINUTES_FROM_S = 100.0  # remaining time from which it is given in minutes
MIN_UNFITTED_SHARE = 0.05  # share of a window above which an unfitted end of a log is reported


def window_json(recording: int, refit: WindowFit, origin: int) -> JsonObject:
    """A window as JSON: `from` and `to` in seconds after the recording's first event, and the fit as `nisus tune`."""
    told: JsonObject = {
        "recording": recording,
        "from": (refit.start - origin) * 1e-9,
        "to": (refit.end - origin) * 1e-9,
        "events": refit.events,
        "adopted": refit.proposed,
        "reason": refit.reason,
    }
    return told | ({} if refit.fitted is None else {"result": fit_json(refit.fitted)})


def window_topics(found: Sequence[tuple[int, WindowFit]], origins: Sequence[int]) -> list[Topic]:
    """Return a table per entry: value and interval in each window, and the value in use after it."""
    keys = dict.fromkeys(line.key for _, refit in found if refit.fitted is not None for line in refit.fitted.lines)
    place = ("recording", "from s", "to s") if len(origins) > 1 else ("from s", "to s")
    head = (*place, "fitted", "95 % interval", "σ moved", "gain, nats a reading", "went on with")
    sections = []
    for key in keys:
        rows = []
        unit = ""
        for k, refit in found:
            lines = () if refit.fitted is None else refit.fitted.lines
            line = next((line for line in lines if line.key == key), None)
            unit = unit or ("" if line is None else line.unit)
            rows.append((*_place(k, refit, origins), *_window_row(refit, line)))
        title = f"{key}{f', {unit}' if unit else ''}"
        sections.append(Topic(title, (), head, tuple(rows)))
    return sections


def _place(k: int, refit: WindowFit, origins: Sequence[int]) -> tuple[str, ...]:
    """Recording, where there are several, start and end of a window, s."""
    begin, end = (f"{(t - origins[k]) * 1e-9:,.0f}" for t in (refit.start, refit.end))
    return (str(k + 1), begin, end) if len(origins) > 1 else (begin, end)


def _window_row(refit: WindowFit, line: EntryFit | None) -> tuple[str, ...]:
    if refit.fitted is None or line is None:
        return ("-", "", "", "", "-")
    verdict = refit.fitted.verdict
    gain = f"{verdict.gain:+.3g} ± {verdict.error:.2g}" if np.isfinite(verdict.gain) else "-"
    kept = f"{line.after if refit.proposed else line.before:.4g}"
    kept += " (adopted)" if refit.proposed and not line.alone else ""
    if line.alone:
        return ("not told", "", "", gain, kept)
    bound = "" if line.told else " (bound)"
    return (f"{line.after:.4g}", f"{line.low:.4g} to {line.high:.4g}{bound}", f"{shift(line):+.1f}", gain, kept)


def windows_verdict(
    twin: Twin, found: Sequence[tuple[int, WindowFit]], origins: Sequence[int], ends: Sequence[int]
) -> Topic:
    """How many were adopted, of each other one why not, and what no window looked at."""
    adopted = sum(refit.proposed for _, refit in found)
    folds = sum(refit.fitted.folds for _, refit in found if refit.fitted is not None)
    said = [f"{adopted} of {len(found)} windows were adopted ({twin.estimator}, {folds} folds)."]
    for k, refit in found:
        if not refit.proposed:
            reasons = (refit.reason,) if refit.fitted is None else against(refit.fitted)
            *recording, begin, end = _place(k, refit, origins)
            which = f"recording {recording[0]}, " if recording else ""
            said.append(f"{which}{begin} to {end} s: {'; '.join(reasons)}.")
    for k, last in enumerate(ends):
        own = [refit for other, refit in found if other == k]
        left = (last - max((refit.end for refit in own), default=origins[k])) * 1e-9
        if left > MIN_UNFITTED_SHARE * max((refit.end - refit.start for refit in own), default=0) * 1e-9:
            which = f"Of recording {k + 1} the" if len(ends) > 1 else "The"
            said.append(f"{which} last {left:,.0f} s are less than half a window, or half a step, and were not fitted.")
    return Topic("Verdict", tuple(said))


ALONE = "not identifiable: unchanged"
BOUND = "only an upper bound: indistinguishable from zero"
EDGE = "at the edge of its range: the optimum may lie beyond"
STOPPED = "The search was ended early: better values may exist."
BY_LIKELIHOOD = "--aim likelihood fits to all measurements, and leaves true states and held-out sensors as a check"
NOT_WRITTEN = "Nothing is written. --apply writes the values into {}, --out FILE into a copy, --keep NAME as a version."
MAX_CORRELATION = 0.2  # Of successive innovations, above which a cause is missing
WELL_TUNED = 0.2  # logarithm of the NIS per degree of freedom within which the values suit
MIN_PULL = 0.1  # deviations by which the weak prior moves an entry, from which on it is reported
PLAIN = "Maximum likelihood, without a prior. Entries that the data do not determine have only a bound."
PENALISED = "Penalised: the weak prior about the twin's values moves {}. --belief none gives plain maximum likelihood."
TEMPERED = "The likelihood of the fitted blocks has weight {:.2g}; more does not improve held-out predictions."


def fit_text(progress: FitProgress, seconds: float) -> str:
    """Return the progress of a fit in words: folds, remaining time, and the best values so far."""
    if not progress.folds:
        return ""
    text = f"{progress.folds} of about {progress.expected} folds"
    if progress.expected > progress.folds:
        left = seconds / progress.folds * (progress.expected - progress.folds)
        text += f", about {left:.0f} s left" if left < MINUTES_FROM_S else f", about {left / 60.0:.0f} min left"
    if progress.judging:
        return f"{text}; the held-out blocks decide how much of the fit remains"
    if not progress.gain > 0.0:
        return text
    return f"{text}; so far {progress.gain:+.3g} on the fitted blocks, not yet checked ({moves_text(progress)})"


def moves_text(progress: FitProgress) -> str:
    """Return the entries that have changed most so far, with their values."""
    moves = sorted(progress.values.items(), key=lambda item: -abs(_move(*item[1])))[:MOVES_SHOWN]
    return ", ".join(f"{key} {digits(before)} -> {digits(after)}" for key, (before, after) in moves)


def _move(before: float, after: float) -> float:
    """Return the size of a change: its logarithm, or relative to the value."""
    if before > 0.0 and after > 0.0:
        return float(np.log(after / before))
    return (after - before) / (abs(before) or 1.0)


def sections(twin: Twin, fitted: Fitted, aim: str, *, written: bool) -> list[Topic]:
    """Return the result of a fit by an aim, from top to bottom; `written` is whether a file was requested."""
    held_out = _held_out(fitted)
    more = [held_out] if held_out.rows else []
    more += [_widths(twin, fitted)] if fitted.widths is not None else []
    return [_entries(twin, fitted), _scores(fitted), *more, _verdict(twin, fitted, aim, written=written)]


def heading(twin: Twin, fitted: Fitted) -> str:
    """Return the comment above a proposed tuning, with its gain."""
    gained = f"{_gained(fitted)} on blocks held out"
    return f"# Fitted by `nisus tune {twin.name}`: {gained}.\n# These sections stand in place of the twin's own.\n"


def _pair(before: float, after: float, form: str, unit: str = "") -> str:
    """Return a figure before and after; a dash where it is unknown."""
    old, new = (f"{value:{form}}" if np.isfinite(value) else "-" for value in (before, after))
    return f"{old} -> {new}{unit if np.isfinite(after) else ''}"


def _entries(twin: Twin, fitted: Fitted) -> Topic:
    rows = [
        (
            line.key,
            finite_text(line.before),
            finite_text(line.after) if fitted.penalised else f"{line.after:,.{PLAIN_DIGITS}g}",
            "" if line.alone else f"{finite_text(line.low)} to {finite_text(line.high)}",
            line.unit,
            _remark(line),
        )
        for line in fitted.lines
    ]
    rows += [(item.key, "", "", "", "", f"not fitted: {item.reason}") for item in fitted.skipped]
    pairs = [
        f"{pair['entries'][0]} with {pair['entries'][1]} ({pair['correlation']:+.2f})" for pair in correlated(fitted)
    ]
    said = [f"Hardly distinguishable: {', '.join(pairs)}."] if pairs else []
    said += [f"{name} was stuck: {n:,} of its readings were left out." for name, n in fitted.left_out.items()]
    said += [prior_text(fitted)]
    head = ("entry", "before", "after", "95 % interval", "unit", "")
    return Topic(f"{twin.name}: {fitted.estimator}, {fitted.folds} folds", tuple(said), head, tuple(rows))


def prior_text(fitted: Fitted) -> str:
    """Return whether the estimates are penalised, and how far the prior moves them."""
    if not fitted.penalised:
        return PLAIN
    moved = [f"{line.key} by {line.pull:+.1f} σ" for line in fitted.lines if abs(line.pull) >= MIN_PULL]
    return PENALISED.format(", ".join(moved) or f"no entry by {MIN_PULL:g} σ or more")


def _remark(line: EntryFit) -> str:
    if line.alone:
        return ALONE
    if line.edge and line.told:
        return EDGE
    return BOUND if not line.told else ""


def _scores(fitted: Fitted) -> Topic:
    def row(what: str, before: PartScore, after: PartScore) -> tuple[str, ...]:
        return (
            what,
            f"{before.n:,}",
            _pair(before.log_density, after.log_density, ".4f"),
            _pair(before.nis, after.nis, ".3f"),
            _pair(100 * before.coverage, 100 * after.coverage, ".1f", " %"),
            _correlation(before, after),
        )

    rows = [row("fitted", fitted.before.fitted, fitted.after.fitted)]
    if fitted.before.held_out.n:
        rows.append(row("held out", fitted.before.held_out, fitted.after.held_out))
    band = "in the 95 % band"
    head = ("blocks", "readings", "log density per reading [nats]", "NIS / dof", band, "largest correlation")
    total = _pair(fitted.before.fitted.log_likelihood, fitted.after.fitted.log_likelihood, ".4f")
    said = (f"Log-likelihood of the fitted readings: {total} nats.",)
    return Topic("Predictions of the next reading, before and after", said, head, tuple(rows))


def most_correlated(before: PartScore) -> str:
    """Return the row whose successive innovations are most correlated; empty without one."""
    return max(before.correlation, key=lambda name: abs(before.correlation[name]), default="")


def _correlation(before: PartScore, after: PartScore) -> str:
    """Return the largest correlation of successive innovations before, and that of the same row after."""
    name = most_correlated(before)
    return f"{name} {_pair(before.correlation[name], after.correlation.get(name, np.nan), '+.2f')}" if name else ""


def _held_out(fitted: Fitted) -> Topic:
    rows: list[tuple[str, ...]] = []
    for kind, group in (("sensor", "sensors"), ("never used", "withheld"), ("truth", "states")):
        rows += _rows(kind, group, fitted.before, fitted.after)
    head = ("", "", "unit", "RMS", "in the 95 % band", "RMS, blocks held out", "in the 95 % band")
    return Topic("Sensors held out in turn, and true states, before and after", (), head, tuple(rows))


def _rows(kind: str, group: str, before: Worth, after: Worth) -> list[tuple[str, ...]]:
    def pair(name: str, worths: tuple[PartScore, PartScore]) -> tuple[str, str]:
        old, new = (getattr(part, group).get(name) for part in worths)
        if not isinstance(old, PredictionScore) or not isinstance(new, PredictionScore):
            return "", ""
        rms = f"{finite_text(old.rms)} -> {finite_text(new.rms)}"
        return rms, _pair(100 * old.coverage, 100 * new.coverage, ".0f", " %")

    parts = (before.fitted, after.fitted), (before.held_out, after.held_out)
    names = dict.fromkeys(name for part in parts for name in getattr(part[0], group))
    units = {name: item.unit for part in parts for name, item in getattr(part[0], group).items()}
    return [(kind, name, units[name], *pair(name, parts[0]), *pair(name, parts[1])) for name in names]


def _widths(twin: Twin, fitted: Fitted) -> Topic:
    """Return the uncertainty of each parameter that a kept version considers."""
    widths = fitted.widths
    assert widths is not None
    units = {item.name: item.unit for item in twin.model.parameters}
    columns = zip(widths.names, widths.std.tolist(), widths.prior.tolist(), strict=True)
    rows = [
        (name, finite_text(std), finite_text(prior), units[name], f"{std / prior:.0%}") for name, std, prior in columns
    ]
    said = f"Errors that last leave 1/{widths.inflation:.3g} of the information. A kept version considers these widths."
    if not find_estimator(fitted.estimator, twin.model).considers:
        said = f"{fitted.estimator} cannot consider parameters: a kept version leaves these widths out."
    head = ("parameter", "std", "without data", "unit", "left")
    return Topic("Uncertainty of the parameters", (said,), head, tuple(rows))


def _gained(fitted: Fitted) -> str:
    return f"{fitted.verdict.gain:+.3g} ± {fitted.verdict.error:.2g} nats {fitted.verdict.each}"


def _verdict(twin: Twin, fitted: Fitted, aim: str, *, written: bool) -> Topic:
    verdict = fitted.verdict
    early = [STOPPED] if fitted.stopped else []
    if not verdict.proposed:
        return Topic("Verdict", ("Not proposed:", *verdict.reasons, *early, f"Next: {next_step(twin, fitted, aim)}"))
    said = [f"Proposed: {_gained(fitted)} on the blocks held out.", *early]
    said += [] if fitted.power == 1.0 else [TEMPERED.format(fitted.power)]
    if aim == WITNESSES and any(line.alone for line in fitted.lines):
        said.append(f"Next, for the entries that are not identifiable: {BY_LIKELIHOOD}.")
    if not written:
        said.append(NOT_WRITTEN.format(twin.path.name))
    return Topic("Verdict", tuple(said))


def next_step(twin: Twin, fitted: Fitted, aim: str) -> str:
    """Return what to try after a fit by an aim that is not proposed."""
    name, verdict, judged = named(twin.path), fitted.verdict, fitted.before.held_out
    if fitted.stopped:
        return f"run it to its end: nisus tune {name}."
    if not judged.n:
        return "hold blocks out with --blocks 9, so that the fit can be judged."
    if all(line.alone for line in fitted.lines):
        if aim == WITNESSES:
            return f"{BY_LIKELIHOOD}: nisus tune {name} --aim likelihood."
        return (
            "fit fewer entries (--fit scale is one factor for Q and R), or give a longer or livelier recording with "
            "--log; the values of the twin stay."
        )
    if edges := ", ".join(line.key for line in fitted.lines if line.edge and line.told):
        return f"widen the bounds of {edges} if that is physically possible, or look for a missing state."
    if not verdict.harmless:
        return (
            f"the noises of the twin compensate for a model error: fit its parameters too (--fit Q,R,p), look at "
            f"nisus check {name}, or give the error a correlation time (nisus advise {name} tests it)."
        )
    before, after = judged.correlation, fitted.after.held_out.correlation
    row = most_correlated(judged)
    if row and abs(before[row]) > MAX_CORRELATION:
        change = f"{before[row]:+.2f} -> {after.get(row, np.nan):+.2f}"
        if abs(after.get(row, 1.0)) <= MAX_CORRELATION:
            return (
                f"the fitted values end the correlation of successive innovations of {row} ({change}), which this log "
                "is too short to confirm: give more recordings with --log."
            )
        return (
            f"successive innovations of {row} are correlated ({change}), so a cause is missing: look at nisus advise "
            f"{name}, which tests remedies, or fit parameters too, with --fit Q,R,p."
        )
    if judged.nis > 0.0 and abs(np.log(judged.nis)) < WELL_TUNED:
        return "nothing: the twin's values already predict the held-out blocks as well."
    return f"give more recordings with --log, or fit other entries, such as --fit Q,R,p; nisus advise {name} helps."
