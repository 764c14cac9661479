"""Calibration of confidence bands and shares of health, in lines of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from estimators.diagnostics.calibration import BANDS, LOW_COVERAGE, TIME, WHOLE, Calibration, CoverageBin
from estimators.diagnostics.intervals import Interval
from estimators.model.state_space import StateSpaceModel
from estimators.tuning import SHARED_ENTRY_ROWS


def calibration_lines(found: Sequence[Calibration], model: StateSpaceModel) -> list[str]:
    """Return a line for each row or state; many rows of a sensor, a family of sensors, or many states share one."""
    many = {
        model.row_names[start + k]: sensor.family or sensor.name
        for sensor, start in zip(model.sensors, model.row_start, strict=True)
        for k in range(len(sensor.rows))
        if sensor.family or len(sensor.rows) >= SHARED_ENTRY_ROWS
    }
    lines: list[str] = []
    groups: dict[tuple[str, str], list[Calibration]] = {}
    states = sum(entry.role == "truth" for entry in found)
    for entry in found:
        group = "states" if entry.role == "truth" and states >= SHARED_ENTRY_ROWS else many.get(entry.subject)
        if group is not None:
            groups.setdefault((group, entry.role), []).append(entry)
        else:
            lines += entry.words
            if not entry.words or entry.role != "used":  # the words of a used row have its figures
                lines.append(f"{entry.subject}{', truth' if entry.role == 'truth' else ''}: {_figures(entry)}")
    for (group, role), entries in groups.items():
        inside = 100 * float(np.mean([entry.coverage[-1].value for entry in entries]))
        bad = [entry for entry in entries if entry.words]
        counted = f"{len(entries)} {'of them' if role == 'truth' else f'rows {role}'}"
        beyond = f"beyond the limits {len(bad)}, as {bad[0].words[0]}" if bad else "none beyond the limits"
        lines.append(f"{group}, {counted}: in the 95 % band {inside:.3g} %; {beyond}")
    return lines


MAX_COVERAGE_ROWS = 12  # rows that are printed; JSON has all
COVERAGE_HEAD = ("", "", "in the 95 % band", "lowest in time", "lowest by operating point", "adaptive interval")


def coverage_rows(found: Sequence[CoverageBin], model: StateSpaceModel) -> list[tuple[str, ...]]:
    """Return a line for each sensor row and true state: its coverage, and the worst by time and operating point.

    Of more than `MAX_COVERAGE_ROWS` those with the lowest coverage.
    """
    units = model.units | {TIME: "s"}
    begun = min((item.low for item in found if item.by == TIME), default=0.0)
    found = [item._replace(low=item.low - begun, high=item.high - begun) if item.by == TIME else item for item in found]
    rows = []
    whole = [entry for entry in found if entry.by == WHOLE]
    lowest = sorted(entry.coverage.value for entry in whole)[:MAX_COVERAGE_ROWS]
    for entry in [entry for entry in whole if entry.coverage.value <= lowest[-1]][:MAX_COVERAGE_ROWS]:
        own = [item for item in found if (item.subject, item.role) == (entry.subject, entry.role)]
        parts = [[item for item in own if item.by == TIME], [item for item in own if item.by not in (TIME, WHOLE)]]
        adaptive = f"{entry.factor:.2f} × band: {_percent(entry.adaptive)}" if np.isfinite(entry.factor) else "-"
        worst = (worst_part(part, units) for part in parts)
        rows.append((entry.subject, entry.role, _share(entry.coverage), *worst, adaptive))
    return rows


def worst_part(parts: Sequence[CoverageBin], units: Mapping[str, str]) -> str:
    """Return the part with the lowest coverage among those whose whole interval is below `LOW_COVERAGE`."""
    low = [item for item in parts if item.coverage.high < LOW_COVERAGE]
    if not low:
        return f"none of {len(parts)} below {_percent(LOW_COVERAGE)}" if parts else "-"
    item = min(low, key=lambda item: item.coverage.high)
    name = "" if item.by == TIME else f"{item.by} "
    unit = units.get(item.by, "")
    place = f"{name}{item.low:.4g} to {item.high:.4g}{f' {unit}' if unit not in ('', '1') else ''}"
    return f"{_share(item.coverage)} at {place}"


def _share(share: Interval) -> str:
    interval = f" ({100 * share.low:.3g} to {100 * share.high:.3g})" if np.isfinite(share.low) else ""
    return f"{_percent(share.value)}{interval}"


def _figures(entry: Calibration) -> str:
    """Return the figures of a calibrated row or state."""
    shares = ", ".join(f"{100 * share.value:.3g}" for share in entry.coverage)
    bands = ", ".join(f"{100 * band:.0f}" for band in BANDS)
    said = [f"{shares} % in the {bands} % bands"]
    if np.isfinite(entry.scale.value):
        low, high = entry.scale.low, entry.scale.high
        interval = f" ({low:.2f} to {high:.2f})" if np.isfinite([low, high]).all() else ""
        said = [f"scale {entry.scale.value:.2f}{interval}", f"bias {entry.bias.value:+.2f} σ", *said]
    if np.isfinite(entry.correlation.value):
        said.insert(2, f"correlation {entry.correlation.value:+.2f}")
    return ", ".join(said)


def health_shares(shares: Mapping[str, float]) -> str:
    """Return shares of time by state of health in words, the largest first."""
    largest = sorted(shares, key=lambda name: -shares[name])
    return ", ".join(f"{name} {_percent(shares[name])}" for name in largest if shares[name])


def _percent(share: float) -> str:
    """Format a share, as 0 % or 100 % only where it is exact."""
    if 0.0 < share < 0.0005:
        return "less than 0.1 %"
    return "more than 99.9 %" if 0.9995 <= share < 1.0 else f"{100 * share:.3g} %"
