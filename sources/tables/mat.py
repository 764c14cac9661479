"""MATLAB files (.mat, up to version 7) as tables: a struct's vectors of equal length are the columns.

A column is named as in MATLAB: `meas.Voltage`, `runs(3).t` (counted from 1), or `speed` for a vector of its own.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estimators.errors import SourceError

from .chunk import CHUNK, Chunk, Problem


def mat_names(path: Path) -> list[str]:
    """Columns of a MATLAB file: every vector of numbers.

    Raises:
        SourceError: If it is none, or of version 7.3, which is HDF5.
    """
    return list(_columns(path))


def _columns(path: Path) -> dict[str, np.ndarray]:
    from scipy.io import loadmat

    try:
        content = loadmat(path, squeeze_me=True, struct_as_record=False)
    except NotImplementedError:
        raise SourceError(f"{path}: it is MATLAB 7.3 (HDF5), which is not read; save it with -v7") from None
    except Exception as error:  # noqa: BLE001  scipy raises many kinds at a broken file
        gist = " ".join(str(error).split())[:160]
        raise SourceError(f"{path}: it cannot be read as a MATLAB file ({gist}); check that it is whole") from None
    found: dict[str, np.ndarray] = {}
    for name, value in content.items():
        if not name.startswith("__"):
            _collect(name, value, found)
    return found


def _collect(name: str, value: Any, found: dict[str, np.ndarray]) -> None:
    """Put the vectors of numbers in `value`, a struct, an array of structs or a vector, under their names."""
    if hasattr(value, "_fieldnames"):
        for field in value._fieldnames:
            _collect(f"{name}.{field}", getattr(value, field), found)
    elif isinstance(value, np.ndarray) and value.dtype == object and value.ndim == 1:
        for k, item in enumerate(value, start=1):
            if hasattr(item, "_fieldnames"):
                _collect(f"{name}({k})", item, found)
    elif isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "biuf":
        found[name] = value


def read_mat(path: Path, time: str, columns: Sequence[str], problem: Problem) -> Generator[Chunk, None, None]:
    """Rows of the vectors; NaN is a value that is missing, and nothing is blank.

    Raises:
        SourceError: If a column is not as long as the time.
    """
    import pyarrow

    found = _columns(path)
    t = found[time]
    for name in columns:
        if found[name].size != t.size:
            raise SourceError(
                f"{path}: {name} has {found[name].size} values and {time} has {t.size}; take columns of one struct"
            )
    for first in range(0, t.size, CHUNK):
        rows = slice(first, min(first + CHUNK, t.size))
        values = np.empty((t[rows].size, len(columns)))
        for k, name in enumerate(columns):
            values[:, k] = found[name][rows]
        lines = np.arange(rows.start, rows.stop) + 1
        yield Chunk(lines, pyarrow.array(np.ascontiguousarray(t[rows])), values, np.zeros(values.shape, np.bool_))
