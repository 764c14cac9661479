"""`nisus new`: a pair of files that runs, and what it refuses."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

import estimators
from app.cli.new import write_twin
from app.twin.twin import load_twin
from estimators.errors import ConfigError
from estimators.fold import fold
from estimators.log import READING, truth_of
from estimators.model.state_space import StateSpaceModel
from estimators.model.user_file import imported_beside, run_file
from estimators.track import USED
from tests.support import as_log, error_of, read_all


def test_the_pair_that_new_writes_loads_as_it_stands(tmp_path):
    yaml_path, python_path = write_twin("my-pump", tmp_path)
    assert (yaml_path.name, python_path.name) == ("my-pump.yaml", "my-pump.py")
    twin = load_twin(yaml_path)
    assert twin.name == "my-pump" and twin.model.state_names == ("level", "delivery")
    # The YAML repeats the model's own values, so that a user sees one set of numbers, whichever file is open.
    np.testing.assert_allclose(twin.tuning.q, [1e-6, 4e-12])
    np.testing.assert_allclose(twin.tuning.r, [1e-4, 2.5e-7])
    np.testing.assert_allclose(twin.tuning.p, [0.5, 0.02])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["my-pump.py", "my-pump.yaml"], "no leftovers"


def test_a_twin_in_the_root_of_a_checkout_loads(tmp_path):
    """As the guide of the first hour has it: the packages of Nisus beside the model are not the user's files."""
    _, written = write_twin("my-pump", tmp_path)
    place = Path(estimators.__file__).resolve().parents[1] / "model_in_the_root.py"
    try:
        shutil.copy(written, place)
        assert imported_beside(place) == ()
        module = run_file("model_in_the_root", place)
        assert any(isinstance(item, StateSpaceModel) for item in vars(module).values())
    finally:
        place.unlink()


def refused(name, folder):
    return error_of(ConfigError, write_twin, name, folder)


@pytest.mark.parametrize("name", ["", "1pump", "../pump", "pump.yaml", "pu mp", "-pump", "pümp"])
def test_a_bad_name_is_refused(name, tmp_path):
    said = refused(name, tmp_path)
    assert f"the name {name!r} is not valid; use letters, digits, _ and -" in said and "begin with a letter" in said
    assert not list(tmp_path.iterdir())


def test_a_name_that_no_file_system_takes_is_refused(tmp_path):
    assert refused("x" * 300, tmp_path) == "the name of the twin has 300 letters; choose one of at most 100"


def test_a_bundled_name_and_an_absent_folder_are_refused(tmp_path):
    assert refused("motor_winding", tmp_path) == "the name 'motor_winding' is that of a bundled twin; choose another"
    absent = tmp_path / "absent"
    assert refused("pump", absent) == f"{absent}: there is no such folder; create it first"


@pytest.mark.parametrize("there", ["pump.yaml", "pump.py"])
def test_nothing_is_overwritten(there, tmp_path):
    (tmp_path / there).write_text("mine")
    said = f"{tmp_path / there}: already exists and is not overwritten; choose another name"
    assert refused("pump", tmp_path) == said
    assert [path.name for path in tmp_path.iterdir()] == [there] and (tmp_path / there).read_text() == "mine"


def test_the_pair_folds_and_does_what_its_text_promises(tmp_path):
    twin = load_twin(write_twin("pump", tmp_path)[0])
    source = twin.open_source(lambda key, text: None, live=False)
    log = as_log(read_all(source))
    track = fold(twin.estimator, twin.model, twin.tuning, log)
    events = log.events
    late = events.select(events.t > 60_000_000_000)
    (rows, level), (other, delivery) = (truth_of(late, k) for k in (0, 1))
    late_mean = track.mean[-len(late) :]
    error = late_mean[rows, 0] - level
    assert np.sqrt(np.mean(error**2)) < 0.01, "below the noise of one reading, 0.01 m"
    miss = late_mean[other, 1] - delivery
    assert np.abs(miss).max() < 5e-5, "a third of the 0.00015 m³ by which the prior is wrong"
    # χ² bounds at 99.99 % of the mean of the NIS of all used readings, one degree of freedom each.
    nis = track.nis[(events.kind == READING) & (track.verdict == USED)]
    low, high = chi2.ppf([0.00005, 0.99995], nis.size) / nis.size
    assert low < nis.mean() < high


@pytest.mark.parametrize("name", ["pump.yaml", "pump.py"])
def test_a_full_disk_leaves_nothing_that_is_in_the_way(name, tmp_path, monkeypatch):
    whole = Path.open

    def full(path, *mode, **options):
        file = whole(path, *mode, **options)
        if path.name == name:
            file = whole(Path("/dev/full"), "w", buffering=1)
        return file

    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", full)
        said = refused("pump", tmp_path)
    assert said == f"{tmp_path / name}: cannot be written: No space left on device; check free space and permissions"
    assert not list(tmp_path.iterdir())
    assert write_twin("pump", tmp_path)[0].is_file()
