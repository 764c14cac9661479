"""The panel's texts: the status line, the list of events, the note about an edit."""

from __future__ import annotations

import html
import math

from estimators.track import DIVERGED, HEALTH_NAMES, TRACKING

from ..engine.host_clock import clock_text
from ..engine.notices import Notice
from ..engine.outputs import Status
from .time_units import SECONDS, Unit

COLORS = {"tracking": "#16a34a", "degraded": "#d97706", "diverged": "#dc2626", "stale": "#6b7280"}
LEVELS = {"info": "#6b7280", "warn": "#d97706", "error": "#dc2626"}
SHOWN = 8
"""States whose integrity is shown."""

COUNTED = ("readings", "gated", "missing", "stale")
SELDOM = ("held out", "screened", "failed", "recovered", "wrong time", "clock moved")


def status_html(status: Status, origin: int | None, unit: Unit = SECONDS) -> str:
    """Health, revision and counts in two lines that keep their places while the numbers run; times as in the charts."""
    health = HEALTH_NAMES[status.health]
    since = ""
    if status.health != TRACKING and status.since is not None and origin is not None:
        since = f" since {unit.text((status.since - origin) * 1e-9)}"
    remedy = ""
    if status.lost is not None:
        when = "" if origin is None else f" since {unit.text((status.lost - origin) * 1e-9)}"
        remedy = (
            f"The estimate is not a number{when}. <b>Reset</b> starts again from the prior; or choose another filter."
        )
    elif status.health == DIVERGED:
        remedy = "The readings contradict the estimate. <b>Reset</b> starts again from the prior."
    at = "" if status.t is None or origin is None else unit.text((status.t - origin) * 1e-9)
    state = "ended" if status.finished else "paused" if status.paused else ""
    fold = "⟳ refolding" if status.refolding else f"revision {status.revision}"
    latency = status.latency_ms
    counts = dict(status.counts)
    known = [(name, counts.pop(name, 0)) for name in COUNTED]
    known += [(name, counts[name]) for name in SELDOM if counts.get(name)]
    cells = "".join(
        f'<span style="margin-right:0.9em;white-space:nowrap"><span style="opacity:0.65">{html.escape(name)}</span> '
        f"{count:,}</span>"
        for name, count in known
    )
    if latency is not None:
        cells += f'<span style="white-space:nowrap"><span style="opacity:0.65">latency</span> {latency:.1f} ms</span>'
    if status.clock is not None:
        text = html.escape(clock_text(status.clock))
        cells += f' <span style="white-space:nowrap"><span style="opacity:0.65">clock</span> {text}</span>'
    return (
        '<div style="padding:0.2em 1.4em 0.6em 0.9em;font-size:0.8em;line-height:1.6;'
        'font-variant-numeric:tabular-nums">'
        '<div style="display:flex;justify-content:space-between;gap:0.5em">'
        f'<b style="color:{COLORS.get(health, "#6b7280")}">● {health}{since}</b>'
        f"<span>{state}</span><span>{fold}</span><span>{at}</span></div><div>{cells}</div><div>{remedy}</div>"
        f"{integrity_html(status)}</div>"
    )


def integrity_html(status: Status) -> str:
    """How wrong each state can be by one fault that nobody notices, beside ± 2 σ; nothing until it is known."""
    found = status.integrity
    if found is None:
        return ""
    muted = '<span style="opacity:0.65">'
    if found.reason:
        return f"<div>{muted}integrity not watched: {html.escape(found.reason)}</span></div>"
    cells = "".join(
        f'<span style="margin-right:0.9em;white-space:nowrap" title="{html.escape(item.fault, quote=True)}">{muted}'
        f"{html.escape(name)}</span> ±{_size(item.two_sigma)} / {_size(item.bound)} {html.escape(item.unit)}</span>"
        for name, item in list(found.bounds.items())[:SHOWN]
    )
    age = found.age(status.t)
    old = "" if age is None else f", {age:.0f} s ago"
    return f"<div>{muted}± 2 σ / integrity bound under one unseen fault{old}:</span> {cells}</div>"


def _size(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "∞"


def events_html(notices: list[Notice], origin: int | None, unit: Unit = SECONDS) -> str:
    """The last events, newest first."""
    style = "padding:0.2em 0.9em 0.6em;font-size:0.8em;line-height:1.5;overflow-wrap:anywhere"
    if not notices:
        return f'<div style="{style};opacity:0.65">Nothing to report.</div>'
    lines = []
    for notice in reversed(notices):
        at = "" if origin is None or notice.t is None else unit.text((notice.t - origin) * 1e-9)
        color = LEVELS.get(str(notice.level).lower(), LEVELS["info"])
        lines.append(
            f'<div style="border-left:3px solid {color};padding-left:0.5em;margin-bottom:0.35em">'
            f'<span style="opacity:0.65">{at}</span> {html.escape(str(notice.text))}</div>'
        )
    return f'<div style="{style}">{"".join(lines)}</div>'


def note_html(text: str) -> str:
    """One line in red, or nothing."""
    if not text:
        return ""
    return f'<div style="color:#dc2626;font-size:0.8em;padding:0 0.9em 0.5em">{html.escape(text)}</div>'
