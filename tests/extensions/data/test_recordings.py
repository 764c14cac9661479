"""Every recording of a bundled twin, from a server with the files of its source, has the values of the copy."""

from fnmatch import fnmatch

import can
import numpy as np
import pytest

from app.extensions.data.sets import recordings
from config.loader import load, shipped
from config.source_schema import CanLogSection
from tests.extensions.data.origin import contents, kaggle, offer, table, written
from tests.skips import recording as copied

NAMES = [*recordings()]


def rows(path):
    """The values of a file, and their tolerances: the copy has times of 1 µs, in doubles of 0.24 µs."""
    if path.suffix == ".csv":
        values = table(path)
        return values, np.where(np.arange(values.shape[1]) == 0, 2e-6, 0.0)
    if path.suffix == ".npz":
        return {name: values.tolist() for name, values in np.load(path).items()}, None
    if path.suffix == ".blf":
        frames = [*can.BLFReader(path)]
        whole = [
            [frame.timestamp, frame.arbitration_id, frame.channel, len(frame.data), *frame.data] for frame in frames
        ]
        return np.array([row + [0] * (12 - len(row)) for row in whole]), np.array([2e-6] + [0.0] * 11)
    return path.read_bytes(), None


def same(one, other):
    values, tolerance = rows(one)
    if tolerance is None:
        assert values == rows(other)[0]
    else:
        assert values.shape == rows(other)[0].shape
        assert (np.abs(values - rows(other)[0]) <= tolerance).all()


@pytest.mark.parametrize("name", NAMES)
def test_a_recording_is_converted_to_the_values_of_the_copy(name, nisus, monkeypatch, tmp_path, origin):
    wanted, copy = recordings()[name], copied(name)
    found = offer(monkeypatch, tmp_path / "here", origin, origin.address, name, contents(name, copy))
    listed = {one["name"]: one for one in nisus("data", "--json").json}
    assert not listed[name]["present"] and origin.asked == []
    given = []
    if found().by_hand:
        line = nisus.refuses("data", "get", wanted.twins[-1])
        assert (
            f"from {found().source} and give it: nisus data get {wanted.twins[0]} --file" in line and origin.asked == []
        )
        given = ["--file", *written(tmp_path / "given", contents(name, copy))]
    assert f"nisus run {wanted.twins[0]} reads it" in nisus("data", "get", wanted.twins[-1], *given).out
    assert [file for file in (tmp_path / "here").iterdir()] == [tmp_path / "here" / name]
    here = sorted(path.relative_to(tmp_path / "here" / name) for path in (tmp_path / "here").rglob("*.*"))
    assert sorted(map(str, here)) == sorted(wanted.makes)
    for file in wanted.makes:
        same(tmp_path / "here" / name / file, copy / file)
    assert nisus("data", "get", name, "--json").json[0]["present"]
    assert len(origin.asked) == (0 if given else len(wanted.files))


@pytest.mark.parametrize("name", NAMES)
def test_unchanged_files_have_the_sha_256_of_the_table(name):
    from hashlib import sha256

    copy = copied(name)
    for file in recordings()[name].files:
        path = copy / file.to
        if path.exists():
            assert (path.stat().st_size, sha256(path.read_bytes()).hexdigest()) == (file.bytes, file.sha256), file.to


def test_the_table_has_all_files_of_all_bundled_twins():
    found = {}
    for twin in shipped():
        source = load(twin).config.source
        for part in getattr(source, "parts", (source,)):
            if getattr(part, "folder", None) is None:
                continue
            dbcs = [item.file for item in part.dbc] if isinstance(part, CanLogSection) else []
            for path in (*part.files, *dbcs):
                name, _, rest = path.partition("/")
                assert any(fnmatch(file, rest) for file in recordings()[name].makes), path
                found.setdefault(name, set()).add(twin)
            assert part.get == f"nisus data get {twin}"
    assert found == {name: set(one.twins) for name, one in recordings().items()}
    assert len(set().union(*found.values())) == 10


def test_files_of_a_source_are_at_a_commit():
    for one in recordings().values():
        for file in one.files:
            _, _, host, owner, repository, commit, *path = file.url.split("/")
            assert host == "raw.githubusercontent.com" and owner and repository and path
            assert len(commit) == 40 and len(file.sha256) == 64 and int(commit, 16) and int(file.sha256, 16)


def test_the_table_of_kaggle_is_converted_and_another_one_refused(nisus, monkeypatch, tmp_path):
    copy = copied("motor_pmsm_paderborn")
    monkeypatch.setenv("NISUS_DATA", str(tmp_path / "here"))
    whole = kaggle(copy)
    other = whole.replace(b",60\n", b",61\n")
    paths = written(
        tmp_path, {"measures_v2.csv": whole, "other.csv": other, "no.csv": b"a,b\n1,2\n", "cut.csv": whole[:99999]}
    )
    for path in paths[1:]:
        line = nisus.refuses("data", "get", "motor_bench", "--file", path)
        assert "give measures_v2.csv" in line
    assert not (tmp_path / "here" / "motor_pmsm_paderborn").exists()
    nisus("data", "get", "motor_bench", "--file", paths[0])
    made = recordings()["motor_pmsm_paderborn"]
    found, expected = (table(folder / made.makes[0]) for folder in (made.folder, copy))
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-8)  # of 9 digits in the copy
