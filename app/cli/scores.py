"""Where the table of `nisus compare` is kept: a CSV file for each twin, which pandas and pyarrow read as it is."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from config.loader import TWINS, shown_path
from estimators.errors import ConfigError

SCORES = TWINS.parent / "scores"
"""Folder of the scores of the twins that ship."""


def scores_file(twin: Path) -> Path:
    """Where the scores of a twin's YAML are: those of one that ships in a folder of their own, others beside it."""
    ships = twin.resolve().parent == TWINS.resolve()
    return SCORES / f"{twin.stem}.csv" if ships else twin.with_name(f"{twin.stem}.scores.csv")


def write_scores(twin: Path, lines: Sequence[Mapping[str, str]]) -> Path:
    """Write the cells of a comparison (see `compare_table.cells`) for a twin's YAML.

    Returns:
        The file.

    Raises:
        ConfigError: If it cannot be written.
    """
    path = scores_file(twin)
    text = io.StringIO()
    writer = csv.DictWriter(text, list(lines[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    try:
        path.parent.mkdir(exist_ok=True)
        path.write_text(text.getvalue(), encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"{shown_path(path)}: {error.strerror}; the scores cannot be written there, check its permissions"
        ) from None
    return path


def read_scores(twin: Path) -> list[dict[str, str]]:
    """The cells of a twin's scores, as they were written; none if there is no such file."""
    try:
        with scores_file(twin).open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))
    except FileNotFoundError:
        return []
