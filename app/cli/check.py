"""`nisus check`: undetectable faults, observability and consistency of a twin, on one page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from config.yaml_files import writing
from estimators.diagnostics.calibration import BANDS
from estimators.diagnostics.episodes import episode_json
from estimators.diagnostics.sensitivity import GramianView, Sensitivity, bounds_of
from estimators.diagnostics.sensitivity.gramian import directions
from estimators.diagnostics.sensitivity.responses import digits
from estimators.track import HEALTH_NAMES

from ..present.export.calibration_lines import calibration_lines
from ..present.result import WORSE, Bar, Topic, plain, to_html, to_text
from ..studies.fold_result import calibration_json
from ..twin.log_reader import read_log
from ..twin.twin import load_twin
from .check_list import MAX_CORRELATION, Checked, ChecklistLine, blamed, check, checklist, health_shares, stamps
from .options import settings
from .prepare import attend, prepare

if TYPE_CHECKING:
    from .arguments import Check as Arguments


def check_twin(arguments: Arguments) -> int:
    """Carry the command out."""
    twin = load_twin(
        arguments.twin,
        log_files=arguments.log or None,
        overrides=settings(arguments.set, arguments.estimator, arguments.tuning),
    )
    prepare(twin)
    log, counts = read_log(twin, arguments.duration)
    checked: Checked = attend(twin.model, lambda: check(twin, log, counts), "checking")
    parts = sections(checked)
    if arguments.html is not None:
        with writing(arguments.html, "--html"):
            arguments.html.write_text(to_html(f"nisus check {twin.name}", parts), encoding="utf-8")
    if arguments.json:
        print(json.dumps(figures(checked), allow_nan=False))
    else:
        print("\n".join(to_text(parts)))
    return 0


def figures(checked: Checked) -> dict[str, Any]:
    """Return all figures of a check; times in seconds of the log, null where there is no number.

    `checklist`: question, answer (yes, partly, no, not told), figures, remedy. `observability`: the Gramian of the log
    and of each window, and pairs of faults that the log hardly distinguishes. `smallest_visible`: minimal detectable
    fault of every sensor row, input and parameter, null if there is none in its range, and the undetectable range `low`
    to `high`. `integrity`: protection level of each state beside 2 σ, and its fault. `held_out`: prediction of each
    sensor row by the others. `open_loop`: RMS without measurements, by sensor row and by state with known truth;
    `worse` where that of the filter is larger.
    """
    return {
        "twin": checked.twin.name,
        "estimator": checked.twin.estimator,
        "span": checked.span,
        "checklist": {line.key: line._asdict() for line in checklist(checked)},
        "observability": _observability_figures(checked),
        "smallest_visible": smallest_visible(checked.sensitivity),
        "integrity": _integrity_figures(checked),
        "held_out": _held_out_figures(checked),
        "open_loop": _open_loop_figures(checked),
        "timing": _timing_figures(checked),
        "calibration": [calibration_json(entry) for entry in checked.calibration],
        "posterior": _posterior_figures(checked),
        "linearity": _linearity_figures(checked),
        "dimension": plain(checked.dimension._asdict()),
        "health": _health_figures(checked),
    }


def _observability_figures(checked: Checked) -> dict[str, Any]:
    found, told = checked.gramian, checked.sensitivity
    return {
        "estimator": found.estimator,
        "reason": found.reason,
        "note": found.note,
        "whole": None if found.whole is None else _view(checked, found.whole),
        "windows": [_view(checked, view) for view in found.windows],
        "blame": [{"one": one, "other": other, "correlation": value} for one, other, value in blamed(told)],
        "deviation": {
            nudge.subject: plain(value) for nudge, value in zip(told.nudges, told.among().deviation, strict=True)
        },
    }


def _view(checked: Checked, view: GramianView) -> dict[str, Any]:
    names = checked.twin.model.state_names
    return {
        "begin": view.begin * 1e-9,
        "end": view.end * 1e-9,
        "rank": view.rank,
        "conditioning": plain(view.conditioning),
        "eigenvalues": plain(view.eigenvalues),
        "left": {name: plain(value) for name, value in zip(names, view.deviation, strict=True)},
        "weakest": view.text,
    }


def smallest_visible(found: Sensitivity) -> list[dict[str, Any]]:
    """Return one entry per nudge: detectable `size` in `unit`, and the undetectable range `low` to `high`."""
    return [
        {
            **{name: plain(getattr(fault.nudge, name)) for name in ("kind", "name", "unit", "value")},
            "size": plain(fault.visible),
            "low": plain(fault.low),
            "high": plain(fault.high),
            "seen": bool(np.isfinite(fault.visible)),
        }
        for fault in found.faults
    ]


def _integrity_figures(checked: Checked) -> dict[str, Any]:
    found = checked.sensitivity
    if found.reason:
        return {"reason": found.reason, "states": {}}
    states = {
        name: {**plain(bound), "fault": bound.fault or None}
        for name, bound in bounds_of(checked.twin.model, found).items()
    }
    return {"reason": "", "note": found.note, "estimator": found.estimator, "states": states}


def _held_out_figures(checked: Checked) -> dict[str, Any]:
    return {
        row.row: {
            "sensor": row.sensor,
            "unit": row.unit,
            "n": row.n,
            "rms": plain(row.rms),
            "bias": plain(row.bias),
            "coverage": {
                f"{100 * band:.0f}": {"value": plain(value), "low": plain(low), "high": plain(high)}
                for band, value, (low, high) in zip(BANDS, row.coverage, row.intervals, strict=True)
            },
            "open_loop": plain(row.open_loop),
            "worse": row.worse,
        }
        for row in checked.held_out.rows
    }


def _open_loop_figures(checked: Checked) -> dict[str, Any]:
    rows, states = checked.held_out.rows, checked.held_out.states
    return {
        "sensors": {row.row: {"unit": row.unit, "rms": plain(row.open_loop)} for row in rows},
        "states": {
            item.state: {
                "unit": item.unit,
                "rms": plain(item.open_loop),
                "filter": plain(item.filter),
                "worse": item.worse,
            }
            for item in states
        },
    }


def _timing_figures(checked: Checked) -> dict[str, Any]:
    section, policy = checked.twin.config.time, checked.twin.policy
    return {
        "stamps": stamps(checked),
        "horizon": section.horizon,
        "degraded_after": plain(policy.degraded_after),
        "stale_after": plain(policy.stale_after),
        "stale": checked.counts["stale"],
        "sensors": {item.sensor: plain(item) for item in checked.arrivals},
    }


def _posterior_figures(checked: Checked) -> dict[str, Any]:
    return {"peaks": plain(checked.peaks), "tails": {tail.row: plain(tail) for tail in checked.tails}}


def _linearity_figures(checked: Checked) -> dict[str, Any]:
    found = checked.linearity
    return {
        **{name: getattr(found, name) for name in ("reason", "exact", "passes", "white", "text")},
        "states": {item.name: plain(item) for item in found.states},
        "rows": {item.name: plain(item) for item in found.rows},
        "whiteness": {item.row: plain(item) for item in found.whiteness},
    }


def _health_figures(checked: Checked) -> dict[str, Any]:
    track = checked.fold.track
    share = np.bincount(track.health, minlength=len(HEALTH_NAMES)) / max(1, len(track))
    return {
        "share": {name: float(value) for name, value in zip(HEALTH_NAMES, share, strict=True)},
        "false_alarm_every": plain(checked.twin.policy.false_alarm_every),
        "episodes": [episode_json(episode) for episode in checked.episodes],
    }


MAX_ROWS = 12  # rows of a table on the page; JSON has all

LATENESS_UNKNOWN = "Lateness is not known: the log has only the time of measurement."


def sections(checked: Checked) -> list[Topic]:
    """Return the sections of the page."""
    return [
        _title(checked),
        _checklist(checked),
        _integrity(checked),
        _visible(checked),
        _observability(checked),
        _blame(checked),
        _held_out(checked),
        _open_loop(checked),
        _timing(checked),
        _health(checked),
    ]


def _number(value: float) -> str:
    return digits(value) if np.isfinite(value) else "-"


def _cut(rows: Sequence[tuple[str, ...]]) -> tuple[tuple[str, ...], ...]:
    """At most `MAX_ROWS` rows, and one that says how many more there are."""
    if len(rows) <= MAX_ROWS + 1:
        return tuple(rows)
    return (*rows[:MAX_ROWS], (f"... and {len(rows) - MAX_ROWS} more, see --json", *[""] * (len(rows[0]) - 1)))


def _title(checked: Checked) -> Topic:
    twin, log = checked.twin, checked.log
    seconds = float(log.t[log.n - 1] - log.t[0]) * 1e-9
    part = "the first" if checked.span is not None else "all"
    said = f"{twin.estimator} over {part} {seconds:.4g} s of its log, {log.n:,} events, {checked.dimension.nx:,} states"
    return Topic(f"{twin.name}: {twin.title}", (said,))


def _checklist(checked: Checked) -> Topic:
    lines = checklist(checked)
    rows = tuple((line.question, line.answer, line.figures, line.remedy) for line in lines)
    head = ("question", "answer", "figures", "remedy")
    return Topic("Checklist", (), head, rows, marks=tuple(map(_mark, lines)))


def _mark(line: ChecklistLine) -> str:
    """Whether the answer is good news: to the question for peaks and tails that is a no."""
    good, bad = ("no", "") if line.key == "posterior" else ("yes", "no")
    return {good: "good", bad: "bad", "not told": ""}.get(line.answer, "partly")


def _integrity(checked: Checked) -> Topic:
    found = checked.sensitivity
    title = "Protection levels: error of a state under one undetectable fault"
    if found.reason:
        return Topic(title, (f"Not computed: {found.reason}.",))
    bounds = bounds_of(checked.twin.model, found)
    rows = [
        (name, item.unit, _number(item.two_sigma), _number(item.bound), item.fault or "none")
        for name, item in bounds.items()
    ]
    bars = [Bar(name, item.unit, item.two_sigma, item.bound) for name, item in bounds.items()]
    said = (f"{found.note}.",) if found.note else ()
    head = ("state", "unit", "± 2 σ", "integrity bound", "by")
    return Topic(title, said, head, _cut(rows), tuple(bars[:MAX_ROWS]), ("± 2 σ", "integrity bound"))


def _visible(checked: Checked) -> Topic:
    found = checked.sensitivity
    title = "Minimal detectable faults"
    if found.reason:
        return Topic(title, (f"Not computed: {found.reason}.",))
    seconds = float(found.t[-1] - found.t[0]) * 1e-9
    rows = []
    for fault in found.faults:
        seen = np.isfinite(fault.visible)
        size = fault.nudge.size_text(fault.visible) if seen else "cannot be seen within its range"
        rows.append((fault.nudge.subject, size, fault.range_text))
    said = [f"{found.note}."] if found.note else []
    said.append(f"A constant fault, there for all of {seconds:.4g} s, seen with a probability of 95 %.")
    return Topic(title, tuple(said), ("fault", "smallest visible", "passes unseen"), _cut(rows))


def _observability(checked: Checked) -> Topic:
    found = checked.gramian
    title = "Observability"
    if found.whole is None:
        return Topic(title, (f"Not computed: {found.reason}.",))
    begin = float(found.whole.begin)
    rows = [
        (
            f"{(view.begin - begin) * 1e-9:.4g} to {(view.end - begin) * 1e-9:.4g} s",
            f"{view.rank} of {checked.twin.model.nx}",
            _number(view.conditioning),
            view.text,
        )
        for view in (found.whole, *found.windows)
    ]
    said = (f"{found.note}.",) if found.note else ()
    return Topic(title, said, ("part of the log", "rank", "conditioning", "weakest direction"), _cut(rows))


def _blame(checked: Checked) -> Topic:
    told = checked.sensitivity
    title = "Faults that are hard to distinguish"
    if told.reason:
        return Topic(title, (f"Not computed: {told.reason}.",))
    said = [f"{told.note}."] if told.note else []
    rows = [(one, other, f"{value:+.2f}") for one, other, value in blamed(told)]
    said.append(
        "The log does not distinguish these faults."
        if rows
        else f"No two faults look alike: no correlation is beyond {MAX_CORRELATION:g}."
    )
    untold = [item for item in directions(told.fisher, told.nudges) if not item.deviation < 1.0] if told.nudges else []
    if untold:
        said.append(
            f"With all unknown together {len(untold)} combination(s) cannot be determined, first {untold[0].text}."
        )
    return Topic(title, tuple(said), ("one", "other", "correlation") if rows else (), _cut(rows) if rows else ())


def _held_out(checked: Checked) -> Topic:
    title = "Each sensor held out and predicted by the others"
    found = checked.held_out.rows
    rows, bars = [], []
    for row in found:
        shares = (f"{100 * share:.3g}" for share in row.coverage)
        verdict = WORSE if row.worse else ""
        figures = (row.row, row.unit, _number(row.rms), f"{row.bias:+.3g}")
        rows.append((*figures, *shares, _number(row.open_loop), verdict))
        bars.append(Bar(row.row, row.unit, row.rms, row.open_loop))
    said = [f"{row.row} is predicted {WORSE}: RMS {_number(row.rms)} {row.unit} by the other sensors, "
            f"{_number(row.open_loop)} by the model alone." for row in found if row.worse]  # fmt: skip
    if len({row.sensor for row in found}) == 1:
        said.append("There is one sensor: held out, it leaves the open loop.")
    bands = tuple(f"in {100 * band:.0f} %" for band in BANDS)
    head = ("sensor row", "unit", "RMS", "bias", *bands, "open loop", "")
    legend = ("RMS by the other sensors", "RMS without any reading")
    return Topic(title, tuple(said[:MAX_ROWS]), head, _cut(rows), tuple(bars[:MAX_ROWS]), legend)


def _open_loop(checked: Checked) -> Topic:
    title = "Filter against the model alone, where the truth is known"
    found = checked.held_out.states
    if not found:
        return Topic(title, ("The log has no true states: see the held-out sensors.",))
    said = tuple(
        f"The filter makes {item.state} {WORSE}: RMS {_number(item.filter)} {item.unit} with its readings, "
        f"{_number(item.open_loop)} without any."
        for item in found
        if item.worse
    )
    rows = [(item.state, item.unit, _number(item.filter), _number(item.open_loop), WORSE if item.worse else "")
            for item in found]  # fmt: skip
    bars = tuple(Bar(item.state, item.unit, item.filter, item.open_loop) for item in found[:MAX_ROWS])
    head = ("state", "unit", "RMS of the filter", "RMS of the open loop", "")
    return Topic(title, said, head, _cut(rows), bars, ("filter", "open loop"))


def _timing(checked: Checked) -> Topic:
    known = any(np.isfinite(item.lateness).any() for item in checked.arrivals)
    rows = [
        (
            item.sensor,
            f"{item.n:,}",
            _number(item.rate),
            _number(item.gap),
            f"{100 * item.missing:.2g}" if np.isfinite(item.missing) else "-",
            " / ".join(_number(value) for value in item.lateness) if known else "not known",
        )
        for item in checked.arrivals
    ]
    head = ("sensor", "readings", "a second", "longest gap, s", "missing, %", "lateness, s: half, 99 %, worst")
    said = () if known else (LATENESS_UNKNOWN,)
    return Topic("Arrival of measurements", said, head, _cut(rows))


def _health(checked: Checked) -> Topic:
    said = [f"{health_shares(checked.fold.track)}."]
    said += [episode.text for episode in checked.episodes[:MAX_ROWS]]
    if len(checked.episodes) > MAX_ROWS:
        said.append(f"... and {len(checked.episodes) - MAX_ROWS} more episodes.")
    said += calibration_lines(checked.calibration, checked.twin.model)[: 2 * MAX_ROWS]
    return Topic("Health and calibration", tuple(said))
