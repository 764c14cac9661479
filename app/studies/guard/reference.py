"""Recorded scores: written when they are accepted, and read to compare with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from config.files import read_text, shown_path
from config.guard_schema import ReferenceSection
from config.problems import report, shown
from config.yaml_lines import parse
from config.yaml_text import as_flow
from estimators.errors import ConfigError
from estimators.log import Log

DIGITS = 10
"""Significant digits of a figure: a thousandth of what it may change by at least."""

ALIKE = 1e-9
"""Relative difference of two sums of one log's values, as another processor's rounding leaves of a simulated one."""


def fingerprint(log: Log) -> tuple[int, float]:
    """Number of events, and the sum of the sizes of their values: alike of the same log on any processor."""
    return log.n, float(np.nansum(np.abs(log.value[: log.n])))


def same_log(one: tuple[int, float], other: tuple[int, float]) -> bool:
    """Whether two fingerprints are of one log."""
    return one[0] == other[0] and abs(one[1] - other[1]) <= ALIKE * max(one[1], other[1])


def read_reference(path: Path) -> ReferenceSection | None:
    """Read recorded scores; None if there are none.

    Raises:
        ConfigError: If the file is wrong.
    """
    if not path.is_file():
        return None
    file = shown_path(path)
    data, places = parse(read_text(path, "nisus guard --accept"), file)
    if not isinstance(data, dict):
        raise ConfigError(f"{file}:1: the file is {shown(data)}; write it anew with `nisus guard --accept`")
    try:
        return ReferenceSection.model_validate(data)
    except ValidationError as error:
        raise report(error, data, places) from None


def write_reference(path: Path, name: str, found: ReferenceSection) -> None:
    """Write recorded scores.

    Raises:
        ConfigError: If the file cannot be written.
    """
    lines = [f"# What `nisus guard` compares {name} with; `nisus guard --accept --note ...` writes it."]
    for key, value in found.model_dump(mode="json", exclude_none=True).items():
        if key == "figures":
            lines += ["figures:", *(f"  {as_flow(name)}: {as_flow(_rounded(each))}" for name, each in value.items())]
        else:
            lines.append(f"{key}: {as_flow(_rounded(value))}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{shown_path(path)}: {error.strerror}; the scores cannot be written there") from None


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: [float(f"{number:.3g}") for number in item] if key == "allowed" else _rounded(item)
                for key, item in value.items()}  # fmt: skip
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
