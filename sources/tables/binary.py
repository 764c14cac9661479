"""Parquet, Arrow, MATLAB and NumPy files: their columns, and their rows a few thousand at a time.

The libraries that read them run in a process of their own, with limited memory (`sources/worker_process.py`).

- Parquet, Arrow (Feather): a column each.
- MATLAB up to version 7: every vector of numbers, named as in MATLAB: `meas.Voltage`, `runs(3).t` (counted from 1),
  or `speed` for a vector of its own.
- NumPy archives: arrays whose first axis is time. A vector is a column under its own name; of an array of more axes
  every cell is one, `t2m_K[3,5]`, counted from 0.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from estimators.errors import SourceError

from ..archives import is_compressed, open_binary
from ..formats import EXTRAS, suffix_of
from ..source import TRUNCATED
from ..worker_process import gist, memory_error, memory_limit
from .text import CHUNK_ROWS, Chunk, Column, Problem, TextCodes, TextMatch, column_of, fill

if TYPE_CHECKING:
    import pyarrow

CHUNK_VALUES = 65_536
"""Values of a chunk of a NumPy archive; a row of a field has thousands."""

MAX_COLUMNS = 1_000_000  # Columns of a NumPy archive, each of which has a name


@contextmanager
def readable(path: Path, kind: str) -> Iterator[None]:
    """Turn the errors of a library that reads a damaged file, or is not installed, into one line."""
    try:
        yield
    except (SourceError, MemoryError):
        raise
    except ModuleNotFoundError as error:
        extra = EXTRAS.get(suffix_of(path))
        raise SourceError(f"{path}: {kind} needs {error.name}: pip install 'nisus[{extra}]'") from None
    except Exception as error:  # noqa: BLE001
        raise SourceError(f"{path}: it cannot be read as {kind} ({gist(error)}); check that it is complete") from None


def content_of(path: Path) -> Path | io.BytesIO:
    """Return what a library that seeks can read: the path, or the decompressed bytes."""
    if not is_compressed(path):
        return path
    limit, content = memory_limit(path) // 2, io.BytesIO()
    with open_binary(path) as file:
        while part := file.read(2**20):
            content.write(part)
            if content.tell() > limit:
                raise memory_error(path, "its content takes more", memory_limit(path))
    content.seek(0)
    return content


def _check_size(path: Path, size: int) -> None:
    limit = memory_limit(path)
    if size > limit:
        raise memory_error(path, f"it declares {size / 2**30:.1f} GiB to be read at once", limit)


def parquet_names(path: Path, time: str = "") -> list[str]:
    """Return the columns of a Parquet file; raises SourceError if it is none, or cut short."""
    import pyarrow.parquet

    with readable(path, "Parquet"):
        return list(pyarrow.parquet.read_schema(content_of(path)).names)


def arrow_names(path: Path, time: str = "") -> list[str]:
    """Return the columns of an Arrow file or stream (Feather); raises SourceError if it is none, or cut short."""
    with readable(path, "Arrow"), _arrow(path) as reader:
        return list(reader.schema.names)


def _arrow(path: Path) -> Any:
    """Open an Arrow file; a stream, if it does not end as one."""
    import pyarrow

    source = pyarrow.PythonFile(content, "r") if isinstance(content := content_of(path), io.BytesIO) else content
    try:
        return pyarrow.ipc.open_file(source)
    except pyarrow.ArrowInvalid:
        if isinstance(content, io.BytesIO):
            content.seek(0)
        return pyarrow.ipc.open_stream(source)


def read_arrow(path: Path, time: str, columns: Sequence[Column], problem: Problem) -> Generator[Chunk, None, None]:
    """Yield the rows of an Arrow file or stream, as those of Parquet."""
    wanted = list(dict.fromkeys((time, *map(column_of, columns))))
    with readable(path, "Arrow"), _arrow(path) as reader:
        count = getattr(reader, "num_record_batches", None)
        whole = reader if count is None else map(reader.get_batch, range(count))
        parts = (
            part.select(wanted).slice(k, CHUNK_ROWS) for part in whole for k in range(0, part.num_rows, CHUNK_ROWS)
        )
        yield from _batches(parts, time, columns, problem)


def read_parquet(path: Path, time: str, columns: Sequence[Column], problem: Problem) -> Generator[Chunk, None, None]:
    """Yield the rows of a Parquet file; null is blank, and text is read as in a CSV."""
    import pyarrow.parquet

    row = 0
    with pyarrow.parquet.ParquetFile(content_of(path)) as file:
        wanted = list(dict.fromkeys((time, *map(column_of, columns))))
        for k in range(file.num_row_groups):
            group = file.metadata.row_group(k)
            chunks = [group.column(j) for j in range(group.num_columns)]
            sizes = [chunk.total_uncompressed_size for chunk in chunks if chunk.path_in_schema in wanted]
            _check_size(path, sum(sizes))
        for chunk in _batches(file.iter_batches(CHUNK_ROWS, columns=wanted), time, columns, problem):
            yield chunk
            row += len(chunk.line)
        if row != file.metadata.num_rows:
            problem(TRUNCATED, row + 1, f"{row} of {file.metadata.num_rows} rows are there")


def _batches(
    batches: Iterable[pyarrow.RecordBatch], time: str, columns: Sequence[Column], problem: Problem
) -> Iterator[Chunk]:
    """Yield the rows of batches of Arrow."""
    import pyarrow

    row = 1
    for batch in batches:
        n = batch.num_rows
        values = np.empty((n, len(columns)))
        blank = np.zeros(values.shape, np.bool_)
        lines = list(range(row, row + n))
        words: tuple[str, ...] = ()
        for k, name in enumerate(columns):
            column = batch.column(column_of(name))
            if not isinstance(name, str) or pyarrow.types.is_dictionary(column.type):
                column = column.cast(pyarrow.string())
            blank[:, k] = column.is_null().to_numpy(zero_copy_only=False)
            if isinstance(name, TextCodes):
                coded = column.dictionary_encode()
                words = tuple(coded.dictionary.to_pylist())
                values[:, k] = coded.indices.fill_null(-1).to_numpy(zero_copy_only=False)
                continue
            if pyarrow.types.is_string(column.type) or pyarrow.types.is_large_string(column.type):
                cells = [item or "" for item in column.to_pylist()]
                fill(name, cells, lines, values[:, k], blank[:, k], problem)
            else:
                numbers = column.cast(pyarrow.float64(), safe=False)
                values[:, k] = numbers.to_numpy(zero_copy_only=False)
        yield Chunk(np.array(lines), batch.column(time), values, blank, words)
        row += n


def _numeric(path: Path, columns: Sequence[Column]) -> list[str]:
    """Return the columns; raises SourceError if one is to be compared as text."""
    for name in columns:
        if isinstance(name, TextMatch):
            raise SourceError(f"{path}: {name.column} holds numbers, not text such as {name.texts[0]!r}; give a number")
        if isinstance(name, TextCodes):
            raise SourceError(f"{path}: {name.column} holds numbers, not names of assets; give a CSV or Parquet file")
    return [column_of(name) for name in columns]


def mat_names(path: Path, time: str = "") -> list[str]:
    """Return the columns of a MATLAB file, or those as long as column `time`.

    Raises:
        SourceError: If it is none, or of version 7.3, which is HDF5.
    """
    found = _vectors(path)
    return [name for name, values in found.items() if time not in found or values.size == found[time].size]


def _vectors(path: Path) -> dict[str, np.ndarray]:
    from scipy.io import loadmat

    with readable(path, "a MATLAB file"):
        try:
            content = loadmat(content_of(path), squeeze_me=True, struct_as_record=False)
        except NotImplementedError:
            raise SourceError(f"{path}: it is MATLAB 7.3 (HDF5), which is not read; save it with -v7") from None
    found: dict[str, np.ndarray] = {}
    for name, value in content.items():
        if not name.startswith("__"):
            _collect(name, value, found)
    if len(found) < 2:
        shapes = {name: np.shape(value) for name, value in content.items() if not name.startswith("__")}
        kinds = {name: type(content[name]).__name__.removeprefix("mat_") for name in shapes}
        held = ", ".join(f"{name} ({'×'.join(map(str, shape)) or kinds[name]})" for name, shape in shapes.items())
        raise SourceError(
            f"{path}: a table has a vector of times and one of values, and it holds {held}; save each "
            f"column as a vector, or those of a struct s with save('{path.name}', '-struct', 's', '-v7')"
        )
    return found


def _collect(name: str, value: object, found: dict[str, np.ndarray]) -> None:
    """Add the vectors of numbers in a struct, an array of structs or a vector, under their names."""
    if hasattr(value, "_fieldnames"):
        for field in value._fieldnames:
            _collect(f"{name}.{field}", getattr(value, field), found)
    elif isinstance(value, np.ndarray) and value.dtype == object and value.ndim == 1:
        for k, item in enumerate(value, start=1):
            if hasattr(item, "_fieldnames"):
                _collect(f"{name}({k})", item, found)
    elif isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "biuf":
        found[name] = value


def read_mat(path: Path, time: str, columns: Sequence[Column], problem: Problem) -> Generator[Chunk, None, None]:
    """Yield the rows of the vectors; NaN is a missing value; raises SourceError if their lengths differ."""
    found = _vectors(path)
    for name in _numeric(path, columns):
        if found[name].size != found[time].size:
            raise SourceError(
                f"{path}: {name} has {found[name].size} values and {time} has {found[time].size}; "
                "take columns of one struct"
            )
    yield from chunks_of(
        found[time], {name: (found[name], [k], [0]) for k, name in enumerate(_numeric(path, columns))}, CHUNK_ROWS
    )


def npz_names(path: Path, time: str = "") -> list[str]:
    """Return the columns of a NumPy archive, or those of as many rows as column `time`; raises SourceError if none."""
    names: list[str] = []
    declared = _declared(path)
    for name, (shape, _) in declared.items():
        if time in declared and shape[0] != declared[time][0][0]:
            continue
        if len(names) + math.prod(shape[1:]) > MAX_COLUMNS:
            raise SourceError(f"{path}: array {name} has the shape {shape}; save at most {MAX_COLUMNS:,} cells a row")
        cells = np.ndindex(shape[1:])
        names += [f"{name}[{','.join(map(str, cell))}]" if cell else name for cell in cells]
    return names


def _declared(path: Path) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Return shape and type of the arrays of numbers and dates in an archive, from their headers alone."""
    found = {}
    with readable(path, "a NumPy archive"), zipfile.ZipFile(content_of(path)) as archive:
        for item in archive.namelist():
            with archive.open(item) as file:
                old = np.lib.format.read_magic(file) == (1, 0)
                header = np.lib.format.read_array_header_1_0 if old else np.lib.format.read_array_header_2_0
                shape, _, dtype = header(file)
            if shape and dtype.kind in "biufM":
                found[item.removesuffix(".npy")] = (shape, dtype)
    return found


def read_npz(path: Path, time: str, columns: Sequence[Column], problem: Problem) -> Generator[Chunk, None, None]:
    """Yield the rows of the arrays; NaN is a missing value; raises SourceError if their lengths differ."""
    declared = _declared(path)
    picks: dict[str, tuple[list[int], list[int]]] = {}
    for k, column in enumerate(_numeric(path, columns)):
        name, _, rest = column.partition("[")
        shape = declared[name][0]
        if shape[0] != declared[time][0][0]:
            raise SourceError(
                f"{path}: {name} has {shape[0]} rows and {time} has {declared[time][0][0]}; take arrays of one length"
            )
        cell = tuple(int(part) for part in rest.rstrip("]").split(",")) if rest else ()
        places, cells = picks.setdefault(name, ([], []))
        places.append(k)
        cells.append(int(np.ravel_multi_index(cell, shape[1:])) if cell else 0)
    _check_size(path, sum(math.prod(declared[name][0]) * declared[name][1].itemsize for name in {time, *picks}))
    with readable(path, "a NumPy archive"), np.load(content_of(path), allow_pickle=False) as archive:
        found = {name: archive[name] for name in {time, *picks}}
    arrays = {name: (found[name], places, cells) for name, (places, cells) in picks.items()}
    yield from chunks_of(found[time], arrays, max(1, CHUNK_VALUES // max(1, len(columns))))


def chunks_of(
    t: np.ndarray, arrays: dict[str, tuple[np.ndarray, list[int], list[int]]], step: int
) -> Generator[Chunk, None, None]:
    """Yield `step` rows at a time of arrays, each with the columns that it fills and the cells of a row to take."""
    import pyarrow

    width = sum(len(places) for _, places, _ in arrays.values())
    for first in range(0, t.size, step):
        rows = slice(first, min(first + step, t.size))
        count = rows.stop - first
        values = np.empty((count, width))
        for array, places, cells in arrays.values():
            values[:, places] = array[rows].reshape(count, -1)[:, cells]
        time = t[rows].astype("datetime64[ns]") if t.dtype.kind == "M" else np.ascontiguousarray(t[rows])
        lines = np.arange(rows.start, rows.stop) + 1
        yield Chunk(lines, pyarrow.array(time), values, np.zeros(values.shape, np.bool_))
