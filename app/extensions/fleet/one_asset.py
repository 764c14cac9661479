"""Copies of tables with the rows of one asset only, so that its history is read at once from those of a whole fleet."""

from __future__ import annotations

import mmap
from collections.abc import Iterator, Sequence
from pathlib import Path

from sources.archives import is_compressed
from sources.formats import suffix_of
from sources.tables.rows import is_text
from sources.tables.text import csv_format


def rows_of_asset(files: Sequence[Path], column: str, asset: str, columns: Sequence[str], folder: Path) -> list[Path]:
    """Return copies of tables, in their order, with the rows of one asset; one that cannot be reduced is itself.

    A copy of a CSV may have other rows in which the name of the asset occurs, so the reader has to select the rows.

    Args:
        files: Tables.
        column: Column with the name of the asset.
        asset: Its name.
        columns: Columns to copy from Parquet; of a CSV, all are.
        folder: Folder of the copies.
    """
    found = []
    for number, path in enumerate(files):
        copy = folder / f"{number}-{path.name}"
        kind = csv_format(path) if is_text(path) and not is_compressed(path) else None
        if kind is not None and not kind.encoding.startswith("utf-16") and kind.first == 2:
            with path.open("rb") as file, copy.open("wb") as out:
                out.writelines(_lines(file.fileno(), asset.encode(kind.encoding.removesuffix("-sig"))))
        elif suffix_of(path) in (".parquet", ".pq") and not is_compressed(path):
            _copy_parquet(path, column, asset, columns, copy)
        else:
            copy = path
        found.append(copy)
    return found


def _lines(file: int, name: bytes) -> Iterator[bytes]:
    """Yield the first line, and the lines in which a name occurs."""
    with mmap.mmap(file, 0, access=mmap.ACCESS_READ) as content:
        end = content.find(b"\n") + 1
        if not end:
            return
        yield content[:end]
        while (at := content.find(name, end)) >= 0:
            start = content.rfind(b"\n", end - 1, at) + 1
            end = content.find(b"\n", at) + 1
            yield content[start : end or len(content)]
            if not end:
                return


def _copy_parquet(path: Path, column: str, asset: str, columns: Sequence[str], copy: Path) -> None:
    import pyarrow
    import pyarrow.compute
    import pyarrow.parquet

    field = pyarrow.compute.field(column)
    kind = pyarrow.parquet.read_schema(path).field(column).type
    # Without a conversion, groups of rows are skipped by their least and greatest names.
    is_name = field == asset if pyarrow.types.is_string(kind) else field.cast(pyarrow.string()) == asset
    pyarrow.parquet.write_table(pyarrow.parquet.read_table(path, columns=list(columns), filters=is_name), copy)
