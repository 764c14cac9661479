"""Into parts of which size or time a recording is split."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

from estimators.errors import ConfigError

SIZES = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
TIMES = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
LEAST_SIZE, LEAST_TIME = 10**5, 1.0
"""Bytes and seconds below which a part would hold little else than what each of them says of its twin."""


@dataclass(frozen=True)
class Split:
    """A part ends when it has taken `size` bytes, or `seconds` after it began, whichever comes first."""

    size: float = math.inf
    seconds: float = math.inf


NEVER = Split()


def parse_split(text: str) -> Split:
    """What `1GB` or `10min` stands for.

    Raises:
        ConfigError: If it is neither a size nor a time, or too little.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([a-zA-Z]+)\s*", text)
    number, unit = (float(match[1]), match[2]) if match else (math.nan, "")
    size = next((bytes_ for name, bytes_ in SIZES.items() if name.lower() == unit.lower()), None)
    if size is not None and LEAST_SIZE <= number * size < math.inf:
        return Split(size=number * size)
    if unit in TIMES and LEAST_TIME <= number * TIMES[unit] < math.inf:
        return Split(seconds=number * TIMES[unit])
    raise ConfigError(
        f"--record-split {text}: must be a size of 100kB or more ({', '.join(SIZES)}) or a time of 1s or more "
        f"({', '.join(TIMES)}), for example 1GB or 10min"
    )


def part_path(path: Path, number: int) -> tuple[Path, int]:
    """Where a part goes: the first to `path`, the others beside it, numbered; a name that is taken is passed over.

    Returns:
        The path, and the number that it has.
    """
    while True:
        part = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
        if number == 1 or not (part.is_symlink() or part.exists()):
            return part, number
        number += 1
