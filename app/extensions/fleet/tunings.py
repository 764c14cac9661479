"""Values of a fleet's tunings by asset, from a table beside its YAML and from the YAML itself."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from config.yaml_files import ValuePlaces, shown_path
from estimators.errors import ConfigError, SourceError, is_blank, nearest, quoted
from estimators.fleet.tunings import GROUPS, out_of_range
from estimators.tuning import Tuning
from sources.tables.text import after_heading, csv_format, open_text
from sources.units import conversion, heading_unit

from .schema import AssetTuningsSection

Cells = dict[str, dict[str, tuple[float, str]]]
"""Value and place of each value, by asset and key."""


class AssetValues(NamedTuple):
    """Values of the tuning (N,) by key, for N assets of these names; NaN is the value of the twin."""

    names: tuple[str, ...] = ()
    columns: Mapping[str, np.ndarray] = {}

    def of(self, asset: str) -> dict[str, float]:
        """Return the values of an asset; none if it has the twin's."""
        if asset not in self.names:
            return {}
        values = {key: float(column[self.names.index(asset)]) for key, column in self.columns.items()}
        return {key: value for key, value in values.items() if not np.isnan(value)}

    def padded(self, count: int) -> dict[str, np.ndarray]:
        """Return the values of these assets, and the twin's for others, (count,) each."""
        return {
            key: np.concatenate([column, np.full(count - column.size, np.nan)]) for key, column in self.columns.items()
        }


def asset_values(
    section: AssetTuningsSection | None, path: Path, places: ValuePlaces, tuning: Tuning, assets: Sequence[str] | None
) -> AssetValues:
    """Return the checked values by asset, in the order of `assets`, or in that of the table.

    Args:
        section: The section `tunings` of the fleet's YAML.
        path: The YAML file.
        places: Places of its values.
        tuning: Tuning of the twin, from which those of the assets differ.
        assets: Names of all assets; None if others may come.

    Raises:
        ConfigError: If the table cannot be read, an asset or a key is unknown, a unit does not fit, or a value is
            missing or out of range; with file, line and remedy.
    """
    if section is None:
        return AssetValues(() if assets is None else tuple(assets))
    cells: Cells = {}
    if section.file is not None:
        file = path.parent / Path(section.file).expanduser()
        if not file.is_file():
            where = places.at(("tunings", "file"))
            raise ConfigError(f"{where}: tunings.file is {quoted(section.file)}; there is no such file: check the path")
        cells = _read(file, section.asset, tuning)
    for asset, given in section.values.items():
        for key, value in given.items():
            place = places.at(("tunings", "values", asset, key))
            _check_key(key, tuning, place)
            cells.setdefault(asset, {})[key] = (value, place)
    names = tuple(cells if assets is None else assets)
    if blank := [asset for asset in cells if is_blank(asset)]:
        place = next((where for _, where in cells[blank[0]].values()), shown_path(path))
        raise ConfigError(f"{place}: asset {quoted(blank[0])} is blank; give it a visible name")
    known = set(names)
    for asset, own in cells.items():
        if asset not in known:
            place = next((where for _, where in own.values()), shown_path(path))
            raise ConfigError(f"{place}: asset {quoted(asset)} is not among assets; {nearest(asset, list(names))}")
    columns = {}
    for key in dict.fromkeys(key for own in cells.values() for key in own):
        found = [cells.get(name, {}).get(key, (np.nan, "")) for name in names]
        columns[key] = np.array([value for value, _ in found])
        if wrong := out_of_range(tuning, key, columns[key]):
            raise ConfigError(f"{found[wrong[0]][1]}: asset {names[wrong[0]]}: {wrong[1]}")
    return AssetValues(names, columns)


def _check_key(key: str, tuning: Tuning, place: str) -> None:
    if key.partition(".")[0] in GROUPS:
        try:
            tuning.rows_of(key)
            return
        except ConfigError as error:
            raise ConfigError(f"{place}: {error}") from None
    known = [name for name in tuning.keys() if name.partition(".")[0] in GROUPS]
    raise ConfigError(f"{place}: {quoted(key)} is no value of Q, R or p, which may differ; {nearest(key, known)}")


def _read(file: Path, asset_column: str, tuning: Tuning) -> Cells:
    """Return the values of a table: a row for each asset, a column for each key, as `KEY` or `KEY [unit]`."""
    shown = shown_path(file)
    try:
        form = csv_format(file)
        with open_text(file, form) as text:
            rows = [
                (line, row) for line, row in enumerate(form.cells(after_heading(text, form)), form.first) if any(row)
            ]
    except (OSError, SourceError, csv.Error) as error:
        raise ConfigError(f"{shown}: cannot be read: {error}") from None
    heads = form.names
    if asset_column not in heads:
        raise ConfigError(f"{shown}:1: has no column {quoted(asset_column)}; {nearest(asset_column, heads)}")
    units = {item.key: item.unit for item in tuning.items()}
    factors: dict[int, tuple[str, float, float]] = {}
    for k, head in enumerate(heads):
        if head == asset_column:
            continue
        unit = heading_unit(head)
        key = head if unit is None else head[: head.rindex(unit)].rstrip(" [(")
        _check_key(key, tuning, f"{shown}:1")
        try:
            factor, offset = (1.0, 0.0) if unit is None else conversion(unit, units.get(key, ""), f"{shown}:1: {key}")
        except SourceError as error:
            raise ConfigError(str(error)) from None
        factors[k] = key, factor, offset
    cells: Cells = {}
    for line, row in rows:
        name = row[heads.index(asset_column)].strip() if len(row) == len(heads) else ""
        if not name:
            rule = f"has {len(row)} cells and the heading {len(heads)}" if len(row) != len(heads) else "names no asset"
            raise ConfigError(f"{shown}:{line}: the row {rule}; complete it")
        if name in cells:
            raise ConfigError(f"{shown}:{line}: asset {quoted(name)} has a row already; give one row for each asset")
        cells[name] = {}
        for k, (key, factor, offset) in factors.items():
            written = row[k].strip().replace(form.decimal, ".")
            try:
                value = float(written) * factor + offset
            except ValueError:
                value = np.nan
            if not np.isfinite(value):
                what = f"is {quoted(row[k].strip())}" if written else "is missing"
                raise ConfigError(f"{shown}:{line}: asset {name}: {heads[k]} {what}; give a number")
            cells[name][key] = value, f"{shown}:{line}"
    return cells
