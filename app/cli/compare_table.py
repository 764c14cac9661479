"""The table of a comparison as text, in the head of a twin's YAML, and read back from there."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estimators.errors import ConfigError

from .compare_fold import Figure, Row

BEGIN, END = "# nisus compare", "# end of nisus compare"
"""Lines around the table."""

GAP = "  "
"""Between columns; no cell holds two spaces."""

NOTES = "notes"


class Cell(NamedTuple):
    """A figure as it is printed: value, spread (NaN if there is none), and half a unit of the last digit."""

    value: float
    spread: float
    rounding: float


def table(rows: Sequence[Row]) -> list[str]:
    """The rows as lines of text: filter, RMSE by unit, mean NIS, share in the 95 % band, cost, notes."""
    units = list(dict.fromkeys(unit for row in rows for unit in row.rmse))
    head = ["filter", *(f"RMSE [{unit}]" for unit in units), "mean NIS", "in band [%]", "µs/step", NOTES]
    cells = [head]
    for row in rows:
        cells.append(
            [
                row.estimator,
                *(_text(row.rmse.get(unit, Figure(np.nan))) for unit in units),
                _text(row.nis),
                _text(Figure(100.0 * row.coverage.value, 100.0 * row.coverage.spread), decimals=1),
                _text(Figure(1e6 * row.seconds_per_step), digits=3),
                notes(row),
            ]
        )
    widths = [max(len(line[k]) for line in cells) for k in range(len(head))]
    return [GAP.join(f"{cell:<{widths[k]}}" for k, cell in enumerate(line)).rstrip() for line in cells]


def _text(figure: Figure, digits: int = 4, decimals: int | None = None) -> str:
    """A figure to as many digits, or so many decimals; with a spread, to the spread's second digit.

    A spread that does not show in them counts as a unit of the last.
    """
    value, spread = figure
    if not np.isfinite(value):
        return "-"
    if decimals is None:
        decimals = max(0, digits - 1 - int(np.floor(np.log10(abs(value))))) if value else digits
    if not np.isfinite(spread):
        return f"{value:.{decimals}f}"
    if spread > 0.0:
        decimals = min(decimals, max(0, 1 - int(np.floor(np.log10(spread)))))
    return f"{value:.{decimals}f}±{max(spread, 10.0**-decimals):.{decimals}f}"


def notes(row: Row) -> str:
    """What else there is to say of a row: when it diverged, the part of the log it folded, options, why it failed."""
    said = []
    if row.diverged:
        seeds = f"in {row.diverged} of {row.seeds} " if row.seeds > 1 else ""
        said.append(f"diverged {seeds}at {row.since:.4g} s, {100 * row.lost:.2g} % of events")
    if row.span is not None:
        said.append(f"first {row.span:g} s")
    said += [f"{name} {value:g}" for name, value in row.options.items()]
    if row.failure:
        said.append(row.failure)
    return ", ".join(said)


def caption(name: str, rows: Sequence[Row], events: int, seconds: float, logs: int) -> str:
    """One line above the table: what was folded, and what a consistent filter's mean NIS would be."""
    over = f"{logs} logs" if logs > 1 else f"{max((row.seeds for row in rows), default=1)} seeds"
    whole = next((row.nis_bounds for row in rows if row.span is None and not row.failure), (np.nan, np.nan))
    return (
        f"{BEGIN} {name}: {events} events in {seconds:.4g} s; NIS if consistent {whole[0]:.3f} to {whole[1]:.3f}; "
        f"± one of {over}"
    )


def write_table(path: Path, lines: Sequence[str]) -> None:
    """Put a caption and a table into the head of a YAML, behind its text, in place of the one that is there.

    Raises:
        ConfigError: If the file cannot be written.
    """
    block = "\n".join([lines[0], *(f"# {line}" for line in lines[1:]), END]) + "\n"
    try:
        text = path.read_text(encoding="utf-8")
        old = re.compile(rf"^{BEGIN} .*?^{END}\n", re.MULTILINE | re.DOTALL)
        if old.search(text):
            text = old.sub(lambda _: block, text, count=1)
        else:
            head = re.match(r"(?:#.*\n)*", text)
            at = head.end() if head else 0
            text = f"{text[:at]}#\n{block}{text[at:]}" if at else block + text
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; the table cannot be written") from None


def read_table(text: str) -> dict[str, dict[str, str]]:
    """The cells of the table in a YAML's head by filter and column; empty if there is none."""
    found = re.search(rf"^{BEGIN} .*?\n(.*?)^{END}$", text, re.MULTILINE | re.DOTALL)
    if not found:
        return {}
    lines = [re.split(r"\s{2,}", line.removeprefix("# ").strip()) for line in found[1].splitlines()]
    return {cells[0]: dict(zip(lines[0], [*cells, ""], strict=False)) for cells in lines[1:]}


def read_cell(text: str) -> Cell:
    """A printed figure; NaN for `-`."""
    if text == "-":
        return Cell(np.nan, np.nan, np.nan)
    value, _, spread = text.partition("±")
    decimals = len(value.partition(".")[2])
    return Cell(float(value), float(spread) if spread else np.nan, 0.5 * 10.0**-decimals)


def read_span(cells: dict[str, str]) -> float | None:
    """Seconds of the log that a row speaks of; None for all."""
    found = re.search(r"first ([\d.e+-]+) s", cells.get(NOTES, ""))
    return float(found[1]) if found else None
