"""Published figures beside those of Nisus: the rows of published.csv, and the tables of docs/published.md.

python -m tests.benchmarks.published     compute all rows and write them into the page
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Mapping
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from estimators import fold

from .. import ROOT
from ..estimators.smoothing.test_textbook import pendulum
from ..textbook import CHAOS, Figures, clark, fitted, simulate, structural

PAGE = ROOT / "docs" / "published.md"
HEADINGS = ("source", "setting", "figure", "published", "Nisus", "tolerance", "tolerance from", "within")


def chaotic(name: str, estimator: str, runs: int = 9, **options: Any) -> Figures:
    """RMSE and NIS of the analyses in runs of 1,000 cycles, seeds 0 and on, without the first cycles."""
    chaos, found = CHAOS[name], []
    model, skipped = chaos.model, chaos.spin_up
    noise = dict.fromkeys([noise.name for noise in model.noises], 0.0)
    for seed in range(runs):
        truth, log = simulate(chaos, 1000, seed)
        run = fold(estimator, model, log, Q=noise, prior=(chaos.mean, chaos.variance * np.eye(model.nx)), **options)
        rows = run.readings(model.sensor_names[0])[skipped:]
        error = np.sqrt(np.mean((run.mean[rows] - truth[skipped:]) ** 2, axis=1))
        found.append((error.mean(), run.track.nis[rows].mean() / model.nx))
    return dict(zip(("RMSE", "NIS per state"), np.transpose(found), strict=True))


CASES = {case.__name__: case for case in (chaotic, structural, fitted, clark, pendulum)}


@cache
def figures(case: str, arguments: str) -> Figures:
    """Return all figures of a case, of which several rows may show one each."""
    return CASES[case](**json.loads(arguments))


def rows() -> list[dict[str, str]]:
    """Return the rows of published.csv."""
    with Path(__file__).with_suffix(".csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def compare(row: Mapping[str, str]) -> tuple[str, ...]:
    """Compute a row of the page, which explains the tolerance."""
    name, _, index = row["figure"].rstrip("]").partition(" [")
    values = np.atleast_1d(figures(row["case"], row["arguments"])[name])
    samples = values[int(index) - 1 :][:1] if index else values
    ours, digits = float(np.median(samples)), -int(Decimal(row["published"]).as_tuple().exponent)
    scatter = float(np.median(abs(samples - ours)))
    tolerance = 0.5 * 10.0**-digits + float(row["allowance"] or 0.0) + 4.0 * scatter
    origin = ", ".join(filter(None, ["digits", row["reason"], f"{samples.size} runs" if scatter else ""]))
    within = "yes" if abs(ours - float(row["published"])) <= tolerance else "no"
    return (*(row[key] for key in HEADINGS[:4]), f"{ours:.{digits + 1}f}", f"{tolerance:.2g}", origin, within)


def main() -> None:
    """Write all tables into the page."""
    text, tables = PAGE.read_text(encoding="utf-8"), dict[str, list[tuple[str, ...]]]()
    for row in rows():
        tables.setdefault(row["table"], [HEADINGS, ("---",) * len(HEADINGS)]).append(compare(row))
        print(*tables[row["table"]][-1], sep=" | ", flush=True)
    for table, lines in tables.items():
        written = "".join(f"| {' | '.join(cells)} |\n" for cells in lines)
        text = re.sub(rf"(?<=<!-- {table} -->\n\n)(\|.*\n)*", written, text)
    PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
