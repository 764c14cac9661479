from pathlib import Path

import numpy as np
import pytest

from app.new import write_twin
from app.twin import load_twin
from estimators.errors import ConfigError


def test_the_pair_that_new_writes_loads_as_it_stands(tmp_path: Path) -> None:
    yaml_path, python_path = write_twin("my-pump", tmp_path)
    assert (yaml_path.name, python_path.name) == ("my-pump.yaml", "my-pump.py")
    twin = load_twin(yaml_path)
    assert twin.name == "my-pump" and twin.model.state_names == ("level", "delivery")
    # The YAML repeats the model's own values, so that a user sees one set of numbers, whichever file is open.
    np.testing.assert_allclose(twin.tuning.q, [1e-6, 4e-12])
    np.testing.assert_allclose(twin.tuning.r, [1e-4, 2.5e-7])
    np.testing.assert_allclose(twin.tuning.p, [0.5, 0.02])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["my-pump.py", "my-pump.yaml"], "no leftovers"


@pytest.mark.parametrize("name", ["", "1pump", "../pump", "pump.yaml", "pu mp", "-pump", "pümp"])
def test_a_bad_name_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        write_twin(name, tmp_path)
    assert str(caught.value) == f"the name {name!r} will not do; use letters, digits, _ and -, and begin with a letter"
    assert list(tmp_path.iterdir()) == []


def test_a_shipped_name_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^the name 'motor_winding' is that of a twin that ships; choose another$"):
        write_twin("motor_winding", tmp_path)


@pytest.mark.parametrize("there", ["pump.yaml", "pump.py"])
def test_nothing_is_overwritten(there: str, tmp_path: Path) -> None:
    (tmp_path / there).write_text("mine")
    with pytest.raises(ConfigError) as caught:
        write_twin("pump", tmp_path)
    assert str(caught.value) == f"{tmp_path / there}: it is there already and is not overwritten; choose another name"
    assert [path.name for path in tmp_path.iterdir()] == [there] and (tmp_path / there).read_text() == "mine"


def test_a_folder_that_is_absent_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is no such folder; make it first$"):
        write_twin("pump", tmp_path / "absent")
