"""Report of a run: settings, scores, episodes, charts, checks and tuning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from estimators.diagnostics.calibration import calibrations, truth_calibration
from estimators.diagnostics.episodes import Episode
from estimators.diagnostics.field_pictures import Picture
from estimators.diagnostics.held_out import offsets
from estimators.diagnostics.score import Score, health_of, score
from estimators.diagnostics.sensitivity import Bound
from estimators.diagnostics.sensitivity.responses import digits
from estimators.log import READING, Events
from estimators.registry import find_entry
from estimators.smoothing.walk import Smoothed
from estimators.track import HEALTH_NAMES, VERDICT_NAMES, Track
from estimators.tuning import GATE_KEYS, Tuning

from ..columns import units_by_name
from ..engine.notices import Annotation
from ..engine.outputs.alarm_guide import advice
from ..format_time import format_time
from ..result import Bar, Topic
from ..study.calibration_lines import calibration_lines, health_shares
from ..twin.changes import difference, in_words
from ..twin.twin import Twin
from .report_charts import charts_html

MAX_ROWS = 60
"""Rows of a table; the rest is counted."""


class Reported(NamedTuple):
    """A run to report: settings, rows and episodes.

    `about` are further lines of the head, by name; `bounds` the protection levels of states, where known; `others` all
    runs of the session: number, change, scores; `before` the episodes of earlier runs, by number and change; `smoothed`
    the smoothed states, if requested; `annotations` the notes of users.
    """

    twin: Twin
    estimator: str
    tuning: Tuning
    events: Events
    track: Track
    pictures: Sequence[Picture]
    episodes: Sequence[Episode]
    marginal: bool
    about: tuple[tuple[str, str], ...] = ()
    bounds: Mapping[str, Bound] | None = None
    others: tuple[tuple[str, ...], ...] = ()
    before: tuple[tuple[str, Sequence[Episode]], ...] = ()
    smoothed: Smoothed | None = None
    annotations: Sequence[Annotation] = ()


def report(run: Reported) -> list[Topic]:
    """Return the topics of the report, from top to bottom."""
    model = run.twin.model
    found = score(run.track, run.events, model, run.pictures, gate=run.tuning.gate, baseline=run.tuning.baseline)
    shown = (run.tuning, run.events, run.track, run.episodes, run.bounds, run.smoothed, run.annotations)
    charts = charts_html(*shown, run.twin.config.view)
    said: tuple[str, ...] = (
        "Time counts from the first event. Red strips mark episodes, flags notes. Drag to zoom, double-click for all.",
    )
    if run.smoothed is not None:
        said += ("Dark lines: smoothed states, which also use later measurements, with ± 2σ.",)
    topics = [_head(run), _scores(run, found), episode_topic(run), *_before(run), *_notes(run)]
    topics += [Topic("Charts", said, html=(charts,)), *_checks(run), _tuning(run)]
    if run.others:
        head = ("run", "change", "NIS / dof", "log L per measurement", "RMSE")
        topics.append(Topic("Runs of the session", (), head, run.others))
    return [topic.cut(MAX_ROWS) for topic in topics]


def _head(run: Reported) -> Topic:
    twin, t = run.twin, run.events.t
    entry = find_entry(run.estimator)
    options = ", ".join(f"{name} {value:g}" for name, value in entry.complete(dict(run.tuning.options)).items())
    rows = [
        ("filter", f"{entry.title} ({run.estimator})" + (f": {options}" if options else "")),
        ("source", _source(twin)),
        (
            "log",
            f"{format_time(int(t[0]))} to {format_time(int(t[-1]))}, {(t[-1] - t[0]) * 1e-9:.6g} s, {len(t):,} events",
        ),
    ]
    given = ", ".join(f"{key}={value}" for key, value in twin.overrides.items())
    if given:
        rows.append(("on the command line", given))
    return Topic(f"{twin.name}: {twin.title}", (), ("", ""), (*rows, *run.about))


def _source(twin: Twin) -> str:
    section = twin.config.source
    files = [path.name for path in twin.plan.log_files or ()]
    given = {name: getattr(section, name, None) for name in ("interface", "channel", "seed")}
    parts = files + [f"{name} {value}" for name, value in given.items() if value is not None]
    return f"{section.type.replace('_', ' ')}, of {twin.path.name}" + (f": {', '.join(parts)}" if parts else "")


def _scores(run: Reported, found: Score) -> Topic:
    track, units = run.track, units_by_name(run.twin.model)
    rows: list[tuple[str, str, str]] = []
    marks: list[str] = []
    if found.nis_readings:
        verdict = found.nis_verdict
        rows.append(("mean NIS", verdict.ratio_text, verdict.said))
        marks.append("good" if verdict.place == "inside" else "bad")
    fits = [(f"RMSE of {name}", name, fit) for name, fit in found.states.items()]
    fits += [(f"RMSE of {name}, held out", name, fit) for name, fit in found.held_out.items()]
    for title, name, fit in fits:
        unit = "" if units[name] == "1" else units[name]
        rows.append((title, f"{digits(fit.rmse)} {unit}".rstrip(), f"{100 * fit.coverage:.3g} % in the 95 % band"))
    if found.field is not None:
        rows.append(("RMSE of all cells", digits(found.field.rmse), f"{100 * found.field.coverage:.3g} % in the band"))
    each = f"{digits(found.log_likelihood_reading)} per measurement"
    rows.append(("log-likelihood", f"{found.log_likelihood:.6g}", each))
    counts = np.bincount(track.verdict[run.events.kind == READING], minlength=len(VERDICT_NAMES))
    verdicts = [
        f"{name} {count:,}" for name, count in zip(VERDICT_NAMES[1:], counts[1:].tolist(), strict=True) if count
    ]
    rows.append(("measurements", f"{int(counts.sum()):,}", ", ".join(verdicts)))
    shares = health_shares(health_of(run.events, track, run.twin.policy))
    rows.append(("health at the end", HEALTH_NAMES[int(track.health[-1])], f"share of time: {shares}"))
    marks += [""] * (len(rows) - len(marks))
    return Topic("Scores", (), ("", "", ""), tuple(rows), marks=tuple(marks))


def episode_topic(run: Reported) -> Topic:
    """Return the episodes of a run with causes, texts and responses."""
    shown = tuple(
        f"{offset.words[0].upper()}{offset.words[1:]}." for offset in offsets(run.events, run.track, run.tuning)
    )
    if not run.episodes:
        of = " of the sensors in use" if shown else ""
        return Topic("Episodes", (f"No faults detected{of}.", *shown))
    rows = [_episode_row(item, run) for item in run.episodes]
    causes = [cause for cause in dict.fromkeys(item.cause for item in run.episodes) if advice(cause, "Response")]
    small = tuple(
        f"{cause.capitalize()}. Usual cause: {advice(cause, 'Usual cause')} Response: {advice(cause, 'Response')}"
        for cause in causes
    )
    return Topic("Episodes", shown, ("time", "subject", "cause", "text and remedy"), tuple(rows), notes=small)


def _episode_row(item: Episode, run: Reported) -> tuple[str, str, str, str]:
    start = float(run.events.t[0]) * 1e-9
    end = "the end" if item.end is None else clock(round(item.end - start, 1))
    when = f"{clock(round(item.start - start, 1))} to {end}"
    return when, item.subject.replace("_", " "), item.cause, item.text


def _before(run: Reported) -> list[Topic]:
    """Return episodes under the settings of earlier runs, which a later setting may hide."""
    rows = [(name, *_episode_row(item, run)) for name, episodes in run.before for item in episodes]
    if not rows:
        return []
    said = "Over the same log with earlier settings; a later setting may hide them."
    return [Topic("Episodes of earlier runs", (said,), ("run", "time", "subject", "cause", "text"), tuple(rows))]


def _notes(run: Reported) -> list[Topic]:
    """Return the notes of users by time."""
    start = int(run.events.t[0])
    rows = [(clock(round((note.t - start) * 1e-9, 1)), note.text) for note in run.annotations]
    return [Topic("Notes", (), ("time", "text"), tuple(rows))] if rows else []


def _checks(run: Reported) -> list[Topic]:
    model, tuning = run.twin.model, run.tuning
    given = model, run.events, run.track
    found = [*calibrations(*given, gate=tuning.gate, marginal=run.marginal), *truth_calibration(*given)]
    lines = [(line,) for line in calibration_lines(found, model)]
    parts = [Topic("Calibration (95 % intervals)", (), ("",), tuple(lines))] if lines else []
    if run.bounds:
        title = "Protection levels: largest error that one undetected fault can cause"
        rows = [
            (name, item.unit, digits(item.two_sigma), digits(item.bound) if np.isfinite(item.bound) else "no bound",
             item.fault or "none")
            for name, item in run.bounds.items()
        ]  # fmt: skip
        bars = tuple(Bar(name, item.unit, item.two_sigma, item.bound) for name, item in run.bounds.items())[:MAX_ROWS]
        head = ("state", "unit", "± 2 σ", "protection level", "fault")
        parts.append(Topic(title, (), head, tuple(rows), bars, ("± 2 σ", "protection level")))
    return parts


def _tuning(run: Reported) -> Topic:
    twin, tuning = run.twin, run.tuning
    changes = difference(twin.estimator, twin.tuning, run.estimator, tuning)
    began = "as recorded" if twin.recorded else "as configured"
    said = f"Changed: {in_words(changes, len(changes))}." if changes else f"All {began}."
    first = {item.key: item.value for item in twin.tuning.items()}
    rows = [(item.key, f"{item.value:.6g}", item.unit, f"{first[item.key]:.6g}") for item in tuning.items()]
    for key in (*GATE_KEYS, *(f"use.{name}" for name in tuning.model.sensor_names)):
        now, before = tuning.get(key), twin.tuning.get(key)
        if key in GATE_KEYS or not now or now != before:
            rows.append((key, _value(now), "", _value(before)))
    marks = ["partly" if now != before else "" for _, now, _, before in rows]
    return Topic("Tuning", (said,), ("entry", "value", "unit", began), tuple(rows), marks=tuple(marks))


def _value(value: float | bool | str | None) -> str:
    return "off" if value is None else ("yes" if value else "no") if isinstance(value, bool) else str(value)


def clock(seconds: float) -> str:
    """Return seconds as a clock: 0:07.3, 12:31, 3:05:00."""
    sign, rest = "-" if seconds < 0 else "", abs(seconds)
    minutes, part = divmod(round(rest, 3), 60)
    hours, minutes = divmod(int(minutes), 60)
    tail = f"{part:06.3f}".rstrip("0").rstrip(".")
    return f"{sign}{hours}:{minutes:02d}:{tail}" if hours else f"{sign}{minutes}:{tail}"
