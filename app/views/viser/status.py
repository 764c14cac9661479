"""The status line of Viser's own window: health with its cause, revision, time; and the note about an edit."""

from __future__ import annotations

import html

from estimators.track import DIVERGED, HEALTH_NAMES, TRACKING

from ...live.outputs import Status
from ...present.drawing.palette import LIGHT, Palette
from .time_units import SECONDS, Unit

SIGNS = {"waiting": "○", "tracking": "●", "suspect": "◐", "degraded": "▲", "diverged": "✖", "stale": "◌"}
"""The sign is there for whoever cannot tell the colours."""

STYLE = "padding:0.2em 1.4em 0.6em 0.9em;font-size:0.85em;line-height:1.6;overflow-wrap:anywhere"


def status_html(status: Status, origin: int | None, unit: Unit = SECONDS, palette: Palette = LIGHT) -> str:
    """Health, state and revision in one line, the cause and what to do below; times since `origin`, ns."""
    health = HEALTH_NAMES[status.health]
    since = ""
    if status.health != TRACKING and status.since is not None and origin is not None:
        since = f" since {unit.text((status.since - origin) * 1e-9)}"
    at = "" if status.t is None or origin is None else unit.text((status.t - origin) * 1e-9)
    state = "ended" if status.finished else "paused" if status.paused else ""
    fold = "folding again" if status.refolding else f"revision {status.revision}"
    if status.awaited is not None:
        fold = f"compiling {status.awaited}, {status.compiling.get(status.awaited) or 0.0:.0f} s"
    color = "rgb({},{},{})".format(*palette.health[health])
    return (
        f'<div style="{STYLE};font-variant-numeric:tabular-nums">'
        '<div style="display:flex;justify-content:space-between;gap:0.5em">'
        f'<b style="color:{color};white-space:nowrap">{SIGNS[health]} {health}{since}</b>'
        f"<span>{state}</span><span>{fold}</span><span>{at}</span></div>"
        f"<div>{_remedy(status, origin, unit)}</div></div>"
    )


def _remedy(status: Status, origin: int | None, unit: Unit) -> str:
    if status.lost is not None:
        when = "" if origin is None else f" since {unit.text((status.lost - origin) * 1e-9)}"
        return f"The estimate is not a number{when}: reset it, or choose another filter."
    if status.health == DIVERGED and not status.cause:
        return "The readings contradict the estimate."
    more = f" ({status.episodes_open - 1} more)" if status.cause and status.episodes_open > 1 else ""
    return html.escape(status.cause) + more


def note_html(text: str, palette: Palette = LIGHT) -> str:
    """One line in red, or nothing."""
    if not text:
        return ""
    color = "rgb({},{},{})".format(*palette.health["diverged"])
    return f'<div style="{STYLE};color:{color}">{html.escape(text)}</div>'
