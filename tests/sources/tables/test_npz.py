"""Archives of NumPy and files of MATLAB as tables: what was saved is what comes out, the same events as of a CSV.

What cannot be read is refused with its reason and the file.
"""

import numpy as np
import pytest
from scipy.io import savemat

from app.twin.twin import load_twin
from estimators.errors import ConfigError, SourceError
from estimators.log import INPUT, READING, TRUTH
from sources.source import Channel
from sources.tables import binary
from sources.tables.binary import read_mat
from sources.tables.rows import format_of, read_rows
from sources.tables.table import Table
from sources.tables.times import TimeColumn
from tests.sources.can.can_tools import same
from tests.support import read_all

T0 = np.datetime64("2019-03-01T00:00", "ns")
RNG = np.random.default_rng(0)
FIELD = RNG.normal(280.0, 5.0, (7, 3, 4)).astype(np.float32)


@pytest.fixture
def archive(tmp_path):
    path = tmp_path / "field.npz"
    np.savez_compressed(
        path, time=T0 + np.arange(7) * np.timedelta64(1, "h"), t=FIELD, one=np.arange(7.0), short=np.zeros(3),
        words=np.array(["a"] * 7),
    )  # fmt: skip
    return path


def table(path, columns, kind=READING):
    channel = Channel(kind, 0, "s", columns, model_units=("K",) * len(columns))
    return Table([path], time=TimeColumn("time"), channels=[channel], width=4)


def test_cells_and_vectors_come_as_they_were_saved(archive, monkeypatch):
    monkeypatch.setattr(binary, "CHUNK_VALUES", 6)  # two rows at once, so that there are several chunks
    assert len(binary.npz_names(archive)) == 12 + 3
    columns = ("t[2,1]", "one", "t[0,3]")
    chunks = list(read_rows(archive, TimeColumn("time"), columns, format_of(archive)))
    assert [chunk.t.size for chunk in chunks] == [2, 2, 2, 1]
    cells = np.column_stack((FIELD[:, 2, 1], np.arange(7.0), FIELD[:, 0, 3]))
    np.testing.assert_array_equal(np.concatenate([chunk.values for chunk in chunks]), cells)
    batch = read_all(table(archive, columns))
    np.testing.assert_array_equal(batch.value[:, :3], cells)
    t = batch.t
    np.testing.assert_array_equal(t, (T0 + np.arange(7) * np.timedelta64(1, "h")).astype(np.int64))


def test_what_is_no_column_or_no_archive_is_refused(archive, tmp_path):
    with pytest.raises(SourceError, match=r"no column 't\[3,0\]'; did you mean t\[2,0\]"):
        table(archive, ("t[3,0]",))
    with pytest.raises(SourceError, match="no column 'words'"):
        table(archive, ("words",))
    with pytest.raises(SourceError, match="short has 3 rows and time has 7; take arrays of one length"):
        read_all(table(archive, ("short",)))
    bad = tmp_path / "bad.npz"
    bad.write_bytes(archive.read_bytes()[:200])
    with pytest.raises(SourceError, match="bad.npz: it cannot be read as a NumPy archive"):
        table(bad, ("one",))


TWIN = """
model: ./field.py:Field
estimator: {name: etkf, options: {members: 5}}
source:
  type: table
  files: field.npz
  time: {column: time}
  sensors:
    thermocouples: {columns: ["t[2,2]"], units: K}
  truth: {temperature: {columns: t, units: K}}
"""


@pytest.fixture
def twin(tmp_path):
    (tmp_path / "field.py").write_text(
        "from estimators.models.thermal_field import thermal_field\nField = thermal_field(10, 9, 1, name='field')\n"
    )
    (tmp_path / "twin.yaml").write_text(TWIN)
    return tmp_path / "twin.yaml"


def test_the_truth_of_a_field_is_all_cells_but_those_that_are_read(twin, tmp_path):
    field = RNG.normal(300.0, 5.0, (3, 10, 9))
    np.savez(tmp_path / "field.npz", time=np.arange(3.0), t=field)
    source = load_twin(twin).open_source(lambda key, text: pytest.fail(text))
    found = np.full((3, 90), np.nan)
    read = []
    while (batch := source.read(0.0)) is not None:
        for t, kind, channel, value in zip(batch.t, batch.kind, batch.channel, batch.value, strict=True):
            if kind == TRUTH:
                known = np.isfinite(value)
                found[t // 10**9, channel + np.flatnonzero(known)] = value[known]
            else:
                read.append(value[0])
    expected = field - 273.15
    np.testing.assert_allclose(read, expected[:, 2, 2], atol=1e-9)
    expected[:, 2, 2] = np.nan
    np.testing.assert_allclose(found.reshape(expected.shape), expected, atol=1e-9)


def test_a_field_takes_one_array(twin, tmp_path):
    twin.write_text(TWIN.replace("columns: t, units", 'columns: ["t[0,0]", "t[0,1]"], units'))
    with pytest.raises(ConfigError, match="temperature is a field of 90 cells; name one array of a table"):
        load_twin(twin)


def channels(prefix=""):
    return (
        Channel(READING, 0, "temp", (f"{prefix}temp",), units=("degC",), model_units=("K",)),
        Channel(INPUT, 0, "power", (f"{prefix}power",)),
        Channel(TRUTH, 0, "x", (f"{prefix}x",)),
    )


def matlab(path, prefix="", time="t"):
    return Table([path], time=TimeColumn(prefix + time), channels=channels(prefix), width=1)


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
    a, b = read_all(matlab(tmp_path / "a.mat", "meas.")), read_all(matlab(tmp_path / "a.csv"))
    assert same(a, b) and len(a) == 27_000


def test_one_of_many_structs_and_plain_vectors_of_integers(tmp_path):
    runs = np.empty(3, object)
    for k in range(3):
        runs[k] = columns(5 + k, seed=k)
    savemat(tmp_path / "b.mat", {"runs": runs, "t": np.arange(4, dtype=np.uint8), **dict.fromkeys("abc", np.ones(4))})
    got = read_all(matlab(tmp_path / "b.mat", "runs(2)."))
    np.testing.assert_array_equal(got.value[got.kind == INPUT, 0], columns(6, seed=1)["power"])
    only = (Channel(TRUTH, 0, "a", ("a",)),)
    plain = Table([tmp_path / "b.mat"], time=TimeColumn("t"), channels=only, width=1)
    assert read_all(plain).t.tolist() == [0, 10**9, 2 * 10**9, 3 * 10**9]


def test_what_a_matlab_file_lacks_is_one_line(tmp_path):
    path = tmp_path / "c.mat"
    savemat(path, {"meas": columns(5)})
    with pytest.raises(SourceError, match=r"c\.mat: there is no column 'meas\.time'; did you mean meas\.t"):
        matlab(path, "meas.", "time")
    savemat(path, {"meas": columns(5) | {"x": np.ones(4)}})
    with pytest.raises(SourceError, match=r"meas\.x has 4 values and meas\.t has 5"):
        read_all(matlab(path, "meas."))
    path.write_bytes(b"MATLAB nonsense" * 20)
    with pytest.raises(SourceError, match=r"c\.mat: it cannot be read as a MATLAB file"):
        matlab(path, "meas.")
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(200))
    with pytest.raises(SourceError, match=r"c\.mat: it is MATLAB 7\.3 \(HDF5\), which is not read; save it with -v7"):
        matlab(path, "meas.")


@pytest.mark.parametrize("n", [5, 9000])
def test_rows_are_counted_from_one_as_in_matlab(tmp_path, n):
    """Complaints name a row; the last of several chunks has one number a row, as the others."""
    savemat(tmp_path / "d.mat", {"meas": columns(n)})
    chunks = list(read_mat(tmp_path / "d.mat", "meas.t", ["meas.x"], lambda *told: None))
    assert np.concatenate([chunk.line for chunk in chunks]).tolist() == list(range(1, n + 1))
    assert all(len(chunk.line) == len(chunk.values) for chunk in chunks)
