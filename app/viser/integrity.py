"""How wrong each state can be by one fault that nobody notices, beside its band, for the panel."""

from __future__ import annotations

import html
import math

from ..engine.outputs import Status

SHOWN = 8
"""States whose integrity is shown."""


def integrity_html(status: Status) -> str:
    """How wrong each state can be by one fault that nobody notices, beside ± 2 σ; nothing until it is known."""
    found = status.integrity
    if found is None:
        return ""
    muted = '<span style="opacity:0.65">'
    if found.reason:
        return f"<div>{muted}integrity not watched: {html.escape(found.reason)}</span></div>"
    # A space between two, where the line may break.
    cells = " ".join(
        f'<span style="margin-right:0.9em;white-space:nowrap" title="{html.escape(item.fault, quote=True)}">{muted}'
        f"{html.escape(name)}</span> ±{_size(item.two_sigma)} / {_size(item.bound)} {html.escape(item.unit)}</span>"
        for name, item in list(found.bounds.items())[:SHOWN]
    )
    age = found.age(status.t)
    old = "" if age is None else f", {age:.0f} s ago"
    return f"<div>{muted}± 2 σ / integrity bound under one unseen fault{old}:</span> {cells}</div>"


def _size(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "∞"
