"""NumPy archives (.npz) as tables: arrays whose first axis is time.

A vector is a column under its own name; of an array of more axes every cell is one, `t2m_K[3,5]`, counted from 0.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from pathlib import Path

import numpy as np

from estimators.errors import SourceError

from .chunk import Chunk, Problem

VALUES = 65_536
"""Values that are handed on at once; a row of a field has thousands."""


def npz_names(path: Path) -> list[str]:
    """Columns of an archive: every vector, and every cell of the arrays of more axes.

    Raises:
        SourceError: If it is none.
    """
    names: list[str] = []
    for name, array in _arrays(path).items():
        cells = np.ndindex(array.shape[1:])
        names += [f"{name}[{','.join(map(str, cell))}]" if cell else name for cell in cells]
    return names


def _arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            found = {name: archive[name] for name in archive.files}
    except Exception as error:  # noqa: BLE001  zipfile and NumPy raise many kinds at a broken file
        gist = " ".join(str(error).split())[:160]
        raise SourceError(f"{path}: it cannot be read as a NumPy archive ({gist}); check that it is whole") from None
    return {name: array for name, array in found.items() if array.ndim >= 1 and array.dtype.kind in "biufM"}


def read_npz(path: Path, time: str, columns: Sequence[str], problem: Problem) -> Generator[Chunk, None, None]:
    """Rows of the arrays; NaN is a value that is missing, and nothing is blank.

    Raises:
        SourceError: If an array is not as long as the time.
    """
    import pyarrow

    found = _arrays(path)
    t = found[time]
    # By array, so that a row of a field is picked from it at once.
    picks: dict[str, tuple[list[int], list[int]]] = {}
    for k, column in enumerate(columns):
        name, _, rest = column.partition("[")
        array = found[name]
        if array.shape[0] != t.size:
            raise SourceError(
                f"{path}: {name} has {array.shape[0]} rows and {time} has {t.size}; take arrays of one length"
            )
        cell = tuple(int(part) for part in rest.rstrip("]").split(",")) if rest else ()
        places, cells = picks.setdefault(name, ([], []))
        places.append(k)
        cells.append(int(np.ravel_multi_index(cell, array.shape[1:])) if cell else 0)
    step = max(1, VALUES // max(1, len(columns)))
    for first in range(0, t.size, step):
        rows = slice(first, min(first + step, t.size))
        count = rows.stop - first
        values = np.empty((count, len(columns)))
        for name, (places, cells) in picks.items():
            values[:, places] = found[name][rows].reshape(count, -1)[:, cells]
        moment = t[rows].astype("datetime64[ns]") if t.dtype.kind == "M" else np.ascontiguousarray(t[rows])
        lines = np.arange(rows.start, rows.stop) + 1
        yield Chunk(lines, pyarrow.array(moment), values, np.zeros(values.shape, np.bool_))
