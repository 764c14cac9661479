"""NumPy archives as tables: what was saved is what comes out, and what cannot be is refused with its reason."""

import numpy as np
import pytest

from app.twin.twin import load_twin
from estimators.errors import ConfigError, SourceError
from estimators.log import READING, TRUTH
from sources.source import Channel
from sources.tables import binary
from sources.tables.rows import format_of, read_rows
from sources.tables.table import Table
from sources.tables.times import TimeColumn
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
    return Table([path], time_column="time", time_unit="s", channels=[channel], width=4)


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
