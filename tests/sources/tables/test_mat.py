"""MATLAB files as tables: names as in MATLAB, the same events as a CSV, and complaints with the file."""

import numpy as np
import pytest
from scipy.io import savemat

from estimators.errors import SourceError
from estimators.log import INPUT, READING, TRUTH
from sources.source import Channel
from sources.tables.binary import read_mat
from sources.tables.table import Table
from tests.sources.can.can_tools import same
from tests.support import read_all


def channels(prefix=""):
    return (
        Channel(READING, 0, "temp", (f"{prefix}temp",), units=("degC",), model_units=("K",)),
        Channel(INPUT, 0, "power", (f"{prefix}power",)),
        Channel(TRUTH, 0, "x", (f"{prefix}x",)),
    )


def table(path, prefix="", time="t"):
    return Table([path], time_column=prefix + time, time_unit="s", channels=channels(prefix), width=1)


def columns(n, seed=0):
    rng = np.random.default_rng(seed)
    found = {name: rng.normal(size=n) for name in ("temp", "power", "x")}
    found["t"] = np.arange(n) * 0.5
    found["temp"][7 % n] = np.nan
    return found


def test_a_struct_gives_the_events_of_a_csv(tmp_path):
    given = columns(9000)  # more than two chunks
    savemat(tmp_path / "a.mat", {"meas": {name: values[:, None] for name, values in given.items()}})
    rows = [",".join(repr(float(given[name][k])) for name in given) for k in range(9000)]
    (tmp_path / "a.csv").write_text(",".join(given) + "\n" + "\n".join(rows) + "\n")
    a, b = read_all(table(tmp_path / "a.mat", "meas.")), read_all(table(tmp_path / "a.csv"))
    assert same(a, b) and len(a) == 27_000


def test_one_of_many_structs_and_plain_vectors_of_integers(tmp_path):
    runs = np.empty(3, object)
    for k in range(3):
        runs[k] = columns(5 + k, seed=k)
    savemat(tmp_path / "b.mat", {"runs": runs, "t": np.arange(4, dtype=np.uint8), **dict.fromkeys("abc", np.ones(4))})
    got = read_all(table(tmp_path / "b.mat", "runs(2)."))
    np.testing.assert_array_equal(got.value[got.kind == INPUT, 0], columns(6, seed=1)["power"])
    only = (Channel(TRUTH, 0, "a", ("a",)),)
    plain = Table([tmp_path / "b.mat"], time_column="t", time_unit="s", channels=only, width=1)
    assert read_all(plain).t.tolist() == [0, 10**9, 2 * 10**9, 3 * 10**9]


def test_what_a_matlab_file_lacks_is_one_line(tmp_path):
    path = tmp_path / "c.mat"
    savemat(path, {"meas": columns(5)})
    with pytest.raises(SourceError, match=r"c\.mat: there is no column 'meas\.time'; did you mean meas\.t"):
        table(path, "meas.", "time")
    savemat(path, {"meas": columns(5) | {"x": np.ones(4)}})
    with pytest.raises(SourceError, match=r"meas\.x has 4 values and meas\.t has 5"):
        read_all(table(path, "meas."))
    path.write_bytes(b"MATLAB nonsense" * 20)
    with pytest.raises(SourceError, match=r"c\.mat: it cannot be read as a MATLAB file"):
        table(path, "meas.")
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(200))
    with pytest.raises(SourceError, match=r"c\.mat: it is MATLAB 7\.3 \(HDF5\), which is not read; save it with -v7"):
        table(path, "meas.")


@pytest.mark.parametrize("n", [5, 9000])
def test_rows_are_counted_from_one_as_in_matlab(tmp_path, n):
    """Complaints name a row; the last of several chunks has one number a row, as the others."""
    savemat(tmp_path / "d.mat", {"meas": columns(n)})
    chunks = list(read_mat(tmp_path / "d.mat", "meas.t", ["meas.x"], lambda *told: None))
    assert np.concatenate([chunk.line for chunk in chunks]).tolist() == list(range(1, n + 1))
    assert all(len(chunk.line) == len(chunk.values) for chunk in chunks)
