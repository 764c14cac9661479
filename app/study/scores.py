"""Scores of filters: the rows of a comparison, their cells in CSV files, and the printed table."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from config.loader import TWINS
from config.yaml_files import writing

from ..result import JsonObject

if TYPE_CHECKING:
    from estimators.diagnostics.field_pictures import Picture
    from estimators.fold import Fold

GAP = "  "  # between printed columns; no cell holds two spaces

NIS, BAND, COST = "mean NIS", "in band [%]", "cost [µs/step]"
DOF = "NIS dof"  # mean degrees of freedom of a measurement, by which printed tables divide the NIS
NIS_PER_DOF = "NIS / dof"
SPAN, EVENTS, LENGTH = "span [s]", "events", "log [s]"
LOST = "diverged [% of events]"
REFUSED = "refused [%]"
JUDGED = "NIS judged"  # mean NIS that the bounds of a baseline judge, where it is another
MIN_JUDGED_CHANGE = 0.005  # relative, from which on it is another


class Spread(NamedTuple):
    """A mean over seeds (or logs), and the standard deviation of one of them; NaN where there is only one."""

    value: float
    spread: float = np.nan


@dataclass(frozen=True)
class FilterScore:
    """Scores of one filter on a log.

    `nis_judged` is the mean NIS that is compared with the bounds: of a baseline, rejected measurements take part.
    `rmse` by unit: the root mean square over the states of that unit whose truth is known, or, where no truth is,
    over the sensors held out. `nis` and its bounds are per measurement, of `nis_dof` degrees of freedom. `coverage` is
    the share of those errors inside their 95 % band. `span` is the part of the log that was folded, s, or None for all
    of it. `diverged` is how many of the `seeds` folds did, `since` when the first of them did (s from the log's start),
    `lost` the share of all events. `refused` is the share of the readings that the gate refused, which are in no other
    figure. `failure` says why there are no numbers.
    """

    estimator: str
    rmse: Mapping[str, Spread]
    nis: Spread
    nis_bounds: tuple[float, float]
    coverage: Spread
    seconds_per_step: float
    options: Mapping[str, float]
    nis_dof: float = 1.0
    nis_judged: float = np.nan
    seeds: int = 1
    span: float | None = None
    diverged: int = 0
    since: float = np.nan
    lost: float = 0.0
    refused: float = 0.0
    failure: str = ""


def pictures_of(fold: Fold, part: slice | None = None) -> list[Picture]:
    """Return the pictures that a fold took of a large field, or those of a part of its rows."""
    taken = [] if fold.pictures is None else fold.pictures.taken
    return taken if part is None else [one for one in taken if part.start < one.before <= part.stop]


def spread(title: str) -> str:
    """The column of a figure's spread over seeds: `RMSE spread [m]` of `RMSE [m]`."""
    name, bracket, unit = title.partition(" [")
    return f"{name} spread{bracket}{unit}"


def cells(rows: Sequence[FilterScore], events: int, seconds: float) -> list[dict[str, str]]:
    """The rows of the filters as text by column, empty where there is nothing to say; all have the same columns.

    Rejected measurements have a column if there are any. `events` and `seconds` are those of the whole log.
    """
    units = list(dict.fromkeys(unit for row in rows for unit in row.rmse))
    gated = any(row.refused > 0.0 for row in rows)
    judged = {row.estimator: abs(row.nis_judged / row.nis.value - 1.0) > MIN_JUDGED_CHANGE for row in rows}
    found = []
    for row in rows:
        line = {"filter": row.estimator}
        for unit in units:
            line |= _figure(f"RMSE [{unit}]", row.rmse.get(unit, Spread(np.nan)))
        line |= _figure(NIS, row.nis)
        low, high = row.nis_bounds
        dof = "" if row.failure else f"{row.nis_dof:.6g}"
        line |= {"NIS low": _number(low, ".3f"), "NIS high": _number(high, ".3f"), DOF: dof}
        if any(judged.values()):
            line[JUDGED] = _number(row.nis_judged, ".4g") if judged[row.estimator] else ""
        line |= _figure(BAND, Spread(100.0 * row.coverage.value, 100.0 * row.coverage.spread), decimals=1)
        line |= {
            COST: _text(Spread(1e6 * row.seconds_per_step), digits=3),
            "seeds": str(row.seeds),
            "diverged": str(row.diverged),
            "diverged at [s]": _number(row.since, ".4g"),
            LOST: _number(100.0 * row.lost, ".2g") if row.diverged else "",
            **({REFUSED: "" if row.failure else _number(100.0 * row.refused, ".2g")} if gated else {}),
            SPAN: "" if row.span is None else f"{row.span:g}",
            "options": " ".join(f"{name}={value:g}" for name, value in row.options.items()),
            "failure": row.failure,
            EVENTS: str(events),
            LENGTH: f"{seconds:.4g}",
        }
        found.append(line)
    return found


def _figure(title: str, figure: Spread, decimals: int | None = None) -> dict[str, str]:
    value, _, deviation = _text(figure, decimals=decimals).partition("±")
    return {title: value, spread(title): deviation}


def _number(value: float, form: str) -> str:
    return format(value, form) if np.isfinite(value) else ""


def _text(figure: Spread, digits: int = 4, decimals: int | None = None) -> str:
    """A figure to as many digits, or so many decimals; with a spread, to the spread's second digit.

    A spread that does not show in them counts as a unit of the last.
    """
    value, deviation = figure
    if not np.isfinite(value):
        return ""
    if decimals is None:
        decimals = max(0, digits - 1 - int(np.floor(np.log10(abs(value))))) if value else digits
    if not np.isfinite(deviation):
        return f"{value:.{decimals}f}"
    if deviation > 0.0:
        decimals = min(decimals, max(0, 1 - int(np.floor(np.log10(deviation)))))
    return f"{value:.{decimals}f}±{max(deviation, 10.0**-decimals):.{decimals}f}"


def printed(name: str, lines: Sequence[Mapping[str, str]], logs: int = 1) -> list[str]:
    """Return caption and table (`cells`) as lines of text; each filter has the 95 % bounds of its NIS.

    `logs` were folded; with one, spreads are over seeds.
    """
    over = f"{logs} logs" if logs > 1 else f"{max((int(line['seeds']) for line in lines), default=1)} seeds"
    first = lines[0]
    caption = f"{name}: {first[EVENTS]} events in {first[LENGTH]} s; ± one of {over}"
    errors = [title for title in first if title.startswith("RMSE [")]
    table = [["filter", *errors, NIS_PER_DOF, "if consistent", BAND, "µs/step", "notes"]]
    for line in lines:
        shown = [_with_spread(line, title) for title in errors]
        shown += [_per_dof(line, NIS), _bounds(line), _with_spread(line, BAND)]
        table.append([line["filter"], *shown, line[COST] or "-", _notes(line)])
    widths = [max(len(line[k]) for line in table) for k in range(len(table[0]))]
    return [caption] + [GAP.join(f"{cell:<{widths[k]}}" for k, cell in enumerate(line)).rstrip() for line in table]


def _with_spread(line: Mapping[str, str], title: str) -> str:
    return f"{line[title]}±{line[spread(title)]}" if line[spread(title)] else line[title] or "-"


def _per_dof(line: Mapping[str, str], title: str) -> str:
    """Return the NIS of a row, or one of its bounds, per degree of freedom."""
    dof = float(line.get(DOF) or 1.0)
    if dof == 1.0 or not line[title]:
        return _with_spread(line, title) if title == NIS else line[title]
    if title != NIS:
        return f"{float(line[title]) / dof:.3f}"
    return _text(Spread(float(line[title]) / dof, float(line[spread(title)] or "nan") / dof))


def _bounds(line: Mapping[str, str]) -> str:
    """Return the 95 % bounds of the NIS of a row per degree of freedom."""
    low, high = (_per_dof(line, f"NIS {end}") for end in ("low", "high"))
    return f"{low} to {high}" if low and high else "-"


def _notes(line: Mapping[str, str]) -> str:
    """Return the notes of a row: divergence, rejected measurements, part of the log, options, failure."""
    notes = []
    if int(line["diverged"]):
        seeds = f"in {line['diverged']} of {line['seeds']} " if int(line["seeds"]) > 1 else ""
        notes.append(f"diverged {seeds}at {line['diverged at [s]']} s, {line[LOST]} % of events")
    if line.get(JUDGED):
        notes.append(f"NIS {float(line[JUDGED]) / float(line[DOF]):.3g} with rejected readings, as its bounds")
    if line.get(REFUSED, "") not in ("", "0"):
        notes.append(f"rejected {line[REFUSED]} % of the readings")
    if line[SPAN]:
        notes.append(f"first {line[SPAN]} s")
    notes += [option.replace("=", " ") for option in line["options"].split()]
    if line["failure"]:
        notes.append(line["failure"])
    return ", ".join(notes)


SCORES = TWINS.parent / "scores"  # folder of the scores of the twins that ship


def scores_file(twin: Path) -> Path:
    """Return the scores file of a twin: a common folder for bundled twins, else beside the YAML."""
    ships = twin.resolve().parent == TWINS.resolve()
    return SCORES / f"{twin.stem}.csv" if ships else twin.with_name(f"{twin.stem}.scores.csv")


def write_scores(twin: Path, lines: Sequence[Mapping[str, str]]) -> Path:
    """Write the cells of a comparison (see `cells`) for a twin's YAML; return the file.

    Raises:
        ConfigError: If it cannot be written.
    """
    path = scores_file(twin)
    text = io.StringIO()
    writer = csv.DictWriter(text, list(lines[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    with writing(path):
        path.parent.mkdir(exist_ok=True)
        path.write_text(text.getvalue(), encoding="utf-8")
    return path


def read_scores(twin: Path) -> list[dict[str, str]]:
    """The cells of a twin's scores, as they were written; none if there is no such file."""
    try:
        with scores_file(twin).open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))
    except FileNotFoundError:
        return []


def row_json(row: FilterScore) -> JsonObject:
    """Return a row for scripts: every figure is its mean, with the standard deviations under `spread`."""
    figures: JsonObject = {"rmse": {unit: figure.value for unit, figure in row.rmse.items()}}
    spreads: JsonObject = {"rmse": {unit: figure.spread for unit, figure in row.rmse.items()}}
    for name in ("nis", "coverage"):
        figures[name], spreads[name] = getattr(row, name)
    return {**asdict(row), **figures, "spread": spreads}
