"""The panel's texts: the status line, the lights of the sensors, episodes and events, the note about an edit."""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Mapping, Sequence

from estimators.diagnostics.episodes import Episode, anchor
from estimators.track import DIVERGED, HEALTH_NAMES, TRACKING

from ..engine.host_clock import clock_text
from ..engine.notices import Notice
from ..engine.outputs import Status
from .integrity import integrity_html
from .time_units import SECONDS, Unit

LIGHTS = {
    "waiting": ("○", "#2563eb"), "tracking": ("●", "#15803d"), "suspect": ("◐", "#a16207"),
    "degraded": ("▲", "#c2410c"), "diverged": ("✖", "#dc2626"), "stale": ("◌", "#6b7280"), "held out": ("–", "#6b7280"),
}  # fmt: skip
"""Sign and colour of each state of the twin and its sensors; the sign is there for whoever cannot tell the colours."""

FEW = 8
"""Sensors that have a light of their own beside the status; more are counted."""

LEVELS = {"info": "#6b7280", "warn": "#d97706", "error": "#dc2626"}
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
    elif status.health == DIVERGED and not status.cause:
        remedy = "The readings contradict the estimate."
    elif status.cause:
        more = f" ({status.episodes_open - 1} more under Events)" if status.episodes_open > 1 else ""
        remedy = html.escape(status.cause) + more
    at = "" if status.t is None or origin is None else unit.text((status.t - origin) * 1e-9)
    state = "ended" if status.finished else "paused" if status.paused else ""
    fold = "⟳ refolding" if status.refolding else f"revision {status.revision}"
    latency = status.latency_ms
    counts = dict(status.counts)
    known = [(name, counts.pop(name, 0)) for name in COUNTED]
    known += [(name, counts[name]) for name in SELDOM if counts.get(name)]
    # A space between two, where the line may break.
    cells = " ".join(
        f'<span style="margin-right:0.9em;white-space:nowrap"><span style="opacity:0.65">{html.escape(name)}</span> '
        f"{count:,}</span>"
        for name, count in known
    )
    if latency is not None:
        cells += f' <span style="white-space:nowrap"><span style="opacity:0.65">latency</span> {latency:.1f} ms</span>'
    if status.clock is not None:
        text = html.escape(clock_text(status.clock))
        cells += f' <span style="white-space:nowrap"><span style="opacity:0.65">clock</span> {text}</span>'
    return (
        '<div style="padding:0.2em 1.4em 0.6em 0.9em;font-size:0.8em;line-height:1.6;'
        'font-variant-numeric:tabular-nums">'
        '<div style="display:flex;justify-content:space-between;gap:0.5em">'
        f"<b>{_light(health, f'{health}{since}')}</b>"
        f"<span>{state}</span><span>{fold}</span><span>{at}</span></div><div>{cells}</div>"
        f'<div>{_lights(status.sensors)}</div><div style="overflow-wrap:anywhere">{remedy}</div>'
        f"{integrity_html(status)}</div>"
    )


def _light(state: str, text: str) -> str:
    sign, color = LIGHTS[state]
    return f'<span style="color:{color};white-space:nowrap">{sign} {html.escape(text)}</span>'


def _lights(sensors: Mapping[str, tuple[str, str]]) -> str:
    """A light for each sensor, with its name and state; of many sensors, how many are in each state."""
    if len(sensors) <= FEW:
        lights = [_light(state, f"{name.replace('_', ' ')} {state}") for name, (state, _) in sensors.items()]
    else:
        counted = Counter(state for state, _ in sensors.values())
        lights = [_light(state, f"{count} sensors {state}") for state, count in counted.most_common()]
    return " ".join(f'<span style="margin-right:0.9em">{light}</span>' for light in lights)


def sensors_html(sensors: Mapping[str, tuple[str, str]]) -> str:
    """What is wrong with each sensor that is not in order, and what to do."""
    lines = [
        f'<div style="margin-bottom:0.35em">{_light(state, f"{name} {state}")}<div>{html.escape(text)}</div></div>'
        for name, (state, text) in sensors.items()
        if state not in ("tracking", "held out")
    ]
    text = "".join(lines) or '<span style="opacity:0.65">Nothing is wrong with any sensor.</span>'
    return f'<div style="padding:0.2em 0.9em 0.6em;font-size:0.8em;line-height:1.5;overflow-wrap:anywhere">{text}</div>'


def episodes_html(episodes: Sequence[Episode], origin: int | None, unit: Unit = SECONDS) -> str:
    """The episodes that last, the earliest first, each with its remedy."""
    lasting = [episode for episode in episodes if episode.end is None]
    if not lasting:
        return ""
    lines = []
    for episode in lasting:
        at = "" if origin is None else f"since {unit.text(episode.start - origin * 1e-9)}"
        lines.append(
            f'<div style="border-left:3px solid {LEVELS["warn"]};padding-left:0.5em;margin-bottom:0.35em">'
            f"<b>{html.escape(episode.subject)}: {html.escape(episode.cause)}</b> "
            f'<span style="opacity:0.65">{at} · ALARMS.md#{anchor(episode.cause)}</span>'
            f"<div>{html.escape(episode.text)}</div></div>"
        )
    style = "padding:0.2em 0.9em 0.6em;font-size:0.8em;line-height:1.5;overflow-wrap:anywhere"
    return f'<div style="{style}"><div style="opacity:0.65">Now</div>{"".join(lines)}</div>'


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
