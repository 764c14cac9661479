"""Timing on a shared machine, and rows of figures that print as a table and are written as JSON."""

from __future__ import annotations

import json
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import Any, NamedTuple, TypeAlias, TypeVar

from app.result import number_text, plain
from estimators.errors import NisusError


class Pair(NamedTuple):
    """Median seconds of two calls, and the median over the pairs of theirs / ours."""

    ours: float
    theirs: float
    ratio: float


class Bound(NamedTuple):
    """Required value of a figure: at most `value`, or at least."""

    figure: str
    value: float
    at_least: bool = False


class BenchmarkRow(NamedTuple):
    """Figures of one case, by heading with its unit, and the bounds that they should meet."""

    name: str
    figures: Mapping[str, float]
    bounds: tuple[Bound, ...] = ()
    remark: str = ""

    def verdicts(self) -> dict[str, bool]:
        """Return whether each bounded figure meets its bound."""
        return {
            bound.figure: self.figures[bound.figure] >= bound.value
            if bound.at_least
            else self.figures[bound.figure] <= bound.value
            for bound in self.bounds
        }

    def text(self) -> str:
        """Return the row as one line."""
        met = self.verdicts()
        cells = [f"{number_text(value):>{max(9, len(head))}}" for head, value in self.figures.items()]
        bounds = [
            f"{bound.figure} {'>=' if bound.at_least else '<='} {bound.value:g} "
            f"{'PASS' if met[bound.figure] else 'FALLS SHORT'}"
            for bound in self.bounds
        ]
        return f"  {self.name:26s} {'  '.join(cells)}   {'; '.join(filter(None, [*bounds, self.remark]))}".rstrip()


Section: TypeAlias = Callable[[], Iterator[BenchmarkRow]]


def seconds(call: Callable[[], object]) -> float:
    """Return the processor seconds of one call."""
    begun = process_time()
    call()
    return process_time() - begun


T = TypeVar("T")


def timed(call: Callable[[], T]) -> tuple[T, float]:
    """Return the result of one call, and its processor seconds."""
    begun = process_time()
    return call(), process_time() - begun


def both(call: Callable[[], object]) -> tuple[float, float]:
    """Return the clock and the processor seconds of one call."""
    begun = perf_counter()
    spent = seconds(call)
    return perf_counter() - begun, spent


def medians(calls: Sequence[Callable[[], object]], repetitions: int) -> list[float]:
    """Return the median seconds of each call, interleaved (A B C A B C); each runs once before, unmeasured."""
    for call in calls:
        call()
    rounds = [[seconds(call) for call in calls] for _ in range(repetitions)]
    return [median(column) for column in zip(*rounds, strict=True)]


def compare(
    ours: Callable[[], object], theirs: Callable[[], object], *, steps: tuple[int, int], repetitions: int
) -> Pair:
    """Return seconds per step of two calls, interleaved; `steps` has the number of steps of each call.

    A ratio is taken within each pair, so that a load longer than a pair affects both.
    """
    ours(), theirs()
    rounds = [(seconds(ours) / steps[0], seconds(theirs) / steps[1]) for _ in range(repetitions)]
    return Pair(median(a for a, _ in rounds), median(b for _, b in rounds), median(b / a for a, b in rounds))


def run_sections(sections: Sequence[Section], file: Path | None = None) -> dict[str, Any]:
    """Print every section as its rows arrive, and write all figures to a JSON file.

    A section without its recording, browser or peer package reports that and is skipped; so is one that fails.
    """
    found: dict[str, Any] = {}
    for section in sections:
        name = f"{section.__module__.rpartition('.')[2]}.{section.__name__}"
        print(f"\n{(section.__doc__ or name).splitlines()[0]}")
        rows: dict[str, Any] = {}
        found[name] = {"rows": rows}
        headings: list[str] = []
        try:
            for row in section():
                if list(row.figures) != headings:
                    headings = list(row.figures)
                    print(f"  {'':26s} {'  '.join(f'{head:>9s}' for head in headings)}")
                print(row.text(), flush=True)
                rows[row.name] = {**row.figures, **({"met": row.verdicts()} if row.bounds else {})}
        except (NisusError, ImportError, OSError) as error:
            found[name]["skipped"] = str(error)
            print(f"  skipped: {error}")
        except Exception as error:  # noqa: BLE001  one section must not end the others
            found[name]["failed"] = f"{type(error).__name__}: {error}"
            traceback.print_exc(file=sys.stderr)
            print(f"  failed: {type(error).__name__}: {error}")
    if file is not None:
        file.write_text(json.dumps(plain(found), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return found
