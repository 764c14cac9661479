"""Compressed tables are read as they are, and a small file that declares gigabytes is refused in one line."""

import io
import zipfile
import zlib

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from estimators.errors import SourceError
from estimators.log import READING
from sources import inspect
from sources.formats import is_recording
from sources.source import Channel
from sources.tables.table import Table, TimeColumn
from tests.sources.can.can_tools import Reports, same
from tests.support import error_of, read_all

COLUMNS = {"t": np.arange(9000) * 0.5, "x": np.random.default_rng(3).normal(size=9000)}
CODECS = {".gz": "gzip", ".bz2": "bz2", ".lz4": "lz4", ".zst": "zstd"}


def write(path):
    if path.name.startswith("a.csv"):
        path.write_text("t,x\n" + "".join(f"{t},{x!r}\n" for t, x in zip(*map(np.ndarray.tolist, COLUMNS.values()))))
    elif path.suffix == ".parquet":
        pq.write_table(pa.table(COLUMNS), path)
    elif path.suffix == ".npz":
        np.savez(path, **COLUMNS)
    else:
        savemat(path, COLUMNS)
    return path


def compress(path, ending):
    target = path.with_name(path.name + ending)
    with pa.CompressedOutputStream(str(target), CODECS[ending]) as file:
        file.write(path.read_bytes())
    return target


def table(path, report=lambda key, text: None, columns=("x",)):
    channel = Channel(READING, 0, "x", columns)
    return Table([path], time=TimeColumn("t"), channels=[channel], width=len(columns), report=report)


@pytest.mark.parametrize("name", ["a.csv", "a.parquet", "a.npz", "a.mat"])
@pytest.mark.parametrize("ending", CODECS)
def test_a_compressed_table_gives_the_events_of_the_plain_one(tmp_path, name, ending):
    plain = write(tmp_path / name)
    packed = compress(plain, ending)
    assert same(read_all(table(plain)), read_all(table(packed)))
    assert is_recording(packed.name) and inspect.is_table(packed)
    [series] = inspect.inspect_recordings([packed]).columns
    np.testing.assert_array_equal(series.values, COLUMNS["x"])


def test_a_compressed_csv_that_is_cut_short_gives_its_rows_and_says_so(tmp_path):
    packed = compress(write(tmp_path / "a.csv"), ".gz")
    packed.write_bytes(packed.read_bytes()[:-5000])
    reports = Reports()
    count = len(read_all(table(packed, reports)))
    assert 4000 < count < 9000
    assert reports.counts == {"truncated file": 1} and f"a.csv.gz:{count + 2}: " in reports.texts["truncated file"]
    packed.write_bytes(b"no gzip at all" * 20)
    with pytest.raises(SourceError, match=r"a\.csv\.gz: it cannot be read"):
        table(packed)


def npz_bomb(path):
    """Two arrays whose headers declare 1.6 GB each."""
    with zipfile.ZipFile(path, "w") as archive:
        for name in COLUMNS:
            header = io.BytesIO()
            declared = {"descr": "<f8", "fortran_order": False, "shape": (200_000_000,)}
            np.lib.format.write_array_header_1_0(header, declared)
            archive.writestr(f"{name}.npy", header.getvalue() + bytes(1000))


def mat_bomb(path):
    """A compressed vector of 2.4 GB of zeros in some MB: the deflated megabyte of zeros, again and again."""
    megabyte, count = 2**20, 2400
    head = np.array([6, 8, 6, 0, 5, 8, 1, count * megabyte // 8, 1, 1], "<u4").tobytes() + b"x".ljust(8, b"\0")
    head += np.array([9, count * megabyte], "<u4").tobytes()
    packer = zlib.compressobj()
    begin = packer.compress(np.array([14, len(head) + count * megabyte], "<u4").tobytes() + head)
    begin += packer.flush(zlib.Z_FULL_FLUSH)
    zeros = packer.compress(bytes(megabyte)) + packer.flush(zlib.Z_FULL_FLUSH)
    body = begin + zeros * count
    path.write_bytes(b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + np.array([15, len(body)], "<u4").tobytes() + body)


def parquet_bomb(path):
    """One row group of 1.3 GB of zeros in four columns."""
    zeros = pa.chunked_array([pa.array(np.zeros(2**20))] * 40)
    options = {"row_group_size": 2**30, "use_dictionary": False, "compression": "zstd"}
    pq.write_table(pa.table(dict.fromkeys("txyz", zeros)), path, **options)


def gzip_bomb(path):
    with pa.CompressedOutputStream(str(path), "gzip") as file:
        for _ in range(600):
            file.write(bytes(2**20))


@pytest.mark.parametrize(
    ("name", "write_bomb"),
    [("a.npz", npz_bomb), ("a.mat", mat_bomb), ("a.parquet", parquet_bomb), ("a.npz.gz", gzip_bomb)],
)
def test_a_small_file_of_gigabytes_is_refused_with_the_limit(tmp_path, name, write_bomb):
    path = tmp_path / name
    write_bomb(path)
    assert path.stat().st_size < 2**24
    columns = ("x", "y", "z") if name == "a.parquet" else ("x",)
    text = error_of(SourceError, lambda: read_all(table(path, columns=columns)))
    assert text.startswith(f"{path}: ")
    assert "1.0 GiB" in text or "1.1 GiB" in text
    assert text.endswith("save it uncompressed, or in smaller files")


def test_an_archive_of_endless_columns_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", t=np.zeros(1), x=np.zeros((1, 1_000_001), np.int8))
    with pytest.raises(SourceError, match=r"a\.npz: array x has the shape \(1, 1000001\); save at most 1,000,000"):
        table(tmp_path / "a.npz")
