"""How fast a replay or a simulation runs at first: as the twin says, unless the command line says otherwise."""

import numpy as np
import pytest

from app.cli.open_twin import opened_twin
from config.loader import load
from estimators.errors import ConfigError

TWIN = (
    "title: tank\nmodel: motor_winding\nestimator: kf\nsource:\n  type: simulator\n  seed: 1\n  step: 1\n"
    "  duration: 60\n  initial: {temperature: 40}\n"
)


def speed_of(path, **options):
    return opened_twin(str(path), **options).open_source(lambda text, level="info": None).speed


@pytest.mark.parametrize(("view", "times"), [("", 1.0), ("view: {speed: 60}\n", 60.0)])
def test_it_is_that_of_the_twin_or_that_of_the_command_line(tmp_path, view, times):
    path = tmp_path / "tank.yaml"
    path.write_text(TWIN + view)
    assert speed_of(path) == times
    assert speed_of(path, speed=5.0) == 5.0
    assert speed_of(path, speed=np.inf) == np.inf
    assert speed_of(path, overrides={"view.speed": "7"}) == 7.0


@pytest.mark.parametrize("speed", ["0", "-1", ".inf", "fast", "1e12"])
def test_one_that_cannot_be_is_said_with_its_place(tmp_path, speed):
    path = tmp_path / "tank.yaml"
    path.write_text(TWIN + f"view:\n  speed: {speed}\n")
    with pytest.raises(ConfigError, match=r"tank\.yaml:11: view\.speed"):
        load(str(path))
