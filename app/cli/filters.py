"""`nisus filters`: the catalogue of estimators, and which of them fit a twin."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from estimators.estimator import Option
from estimators.log import READING
from estimators.registry import ESTIMATORS, unfit

from ..twin.log_reader import read_log
from ..twin.twin import Twin, load_twin
from .prepare import attend

if TYPE_CHECKING:
    from .arguments import Filters as Arguments

WIDTH = 150
"""Columns of the output where it is not a terminal."""

SAMPLE = 60.0
"""Seconds of a twin's source from which its rate is taken."""


def show_filters(arguments: Arguments) -> int:
    """Carry the command out."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    console.print(catalogue() if arguments.twin is None else fitting(load_twin(arguments.twin)))
    return 0


def catalogue() -> Table:
    """All estimators: what they assume, their options, cost, failure and source."""
    table = Table(show_lines=True)
    for title in ("name", "assumes", "options (default, range)", "model runs a step", "fails when", "source"):
        table.add_column(title, overflow="fold", no_wrap=title == "name")
    for entry in ESTIMATORS.values():
        table.add_row(
            f"[bold]{entry.name}[/]\n{entry.family}",
            f"{entry.title}: {entry.assumes}",
            "\n".join(map(option_text, entry.options)) or "none",
            entry.model_runs,
            entry.fails_when,
            entry.source,
        )
    return table


def option_text(option: Option) -> str:
    """One option with its default, range and unit."""
    unit = f" {option.unit}" if option.unit else ""
    whole = ", whole" if option.whole else ""
    return f"{option.name} {option.default:g}{unit} ({option.low:g} to {option.high:g}{whole}): {option.meaning}"


def fitting(twin: Twin) -> Table:
    """Which estimators apply to a twin, with what they cost there, and why the others do not."""
    rate = reading_rate(twin)
    table = Table(title=f"{twin.name}: {twin.model.nx:,} states, {rate:.3g} readings a second")
    for title, justify in (
        ("name", "left"),
        ("memory", "right"),
        ("model runs a second", "right"),
        ("applies", "left"),
    ):
        table.add_column(title, justify=justify, overflow="fold")  # type: ignore[arg-type]
    for name, entry in ESTIMATORS.items():
        reason = unfit(entry, twin.model)
        if reason is not None:
            table.add_row(f"[dim]{name}[/]", "", "", f"[dim]no: {reason}[/]")
            continue
        options = entry.complete(dict(twin.options_of(name)))
        numbers = entry.state_size(options, twin.model.nx) + entry.memory(options, twin.model)
        runs = entry.runs(options, twin.model.nx)
        table.add_row(
            f"[bold]{name}[/]",
            f"{numbers:,} × 8 B = {bytes_text(8 * numbers)}",
            f"{count_text(runs)} × {rate:.3g} = {count_text(runs * rate)}",
            "yes, and runs first" if name == twin.estimator else "yes",
        )
    return table


def reading_rate(twin: Twin) -> float:
    """Events a second of the twin's source, by its first minute."""
    log, _ = attend(twin.model, lambda: read_log(twin, SAMPLE), "reading the source's first minute")
    events = log.events
    times = events.t[events.kind == READING]
    return float((times.size - 1) / (times[-1] - times[0]) * 1e9) if times.size > 1 and times[-1] > times[0] else 0.0


def count_text(count: float) -> str:
    """A number of runs: whole from a hundred on, three digits below."""
    return f"{count:,.0f}" if count >= 100.0 else f"{count:.3g}"


def bytes_text(count: float) -> str:
    """A number of bytes with a prefix."""
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if count < 1000.0 or unit == "TB":
            return f"{count:.3g} {unit}"
        count /= 1000.0
    raise AssertionError
