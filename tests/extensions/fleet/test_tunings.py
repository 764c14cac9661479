"""Values of tunings by asset in a fleet's YAML: each asset equals a fold with that tuning; mistakes are one line."""

import json
import re

import numpy as np

from app.extensions.fleet.plan import load_fleet
from app.extensions.fleet.running import RunningFleet
from app.twin.twin import load_twin
from estimators import Log
from estimators.errors import ConfigError
from sources.source import NO_ASSET
from tests.cases import cases
from tests.support import error_of

ASSETS = ("a", "b", "pump 3")


def write(folder, table=None, **more):
    """Write a fleet of motor windings; return its path."""
    lines = ["time,pump,temperature"]
    lines += [f"{k},{asset},{40 + k + j}" for k in range(20) for j, asset in enumerate(ASSETS)]
    (folder / "data.csv").write_text("\n".join(lines) + "\n")
    if table is not None:
        (folder / "tunings.csv").write_text(table)
    source = {
        "type": "table", "files": "data.csv", "time": {"column": "time"}, "asset": "pump",
        "sensors": {"winding": {"columns": "temperature"}},
    }  # fmt: skip
    path = folder / "pumps.yaml"
    path.write_text(json.dumps({"twin": "motor_winding", "source": source, **more}, indent=1))
    return path


def estimates(path):
    """Fold a fleet; return its table by asset, and the reports."""
    said: list[str] = []
    running = RunningFleet(load_fleet(path), lambda key, text: said.append(key), threads=1)
    running.run()
    running.stop()
    _, names, table = running.table()
    return {name: table.mean[k] for k, name in enumerate(names)}, said


def folded(asset, **values):
    """Return the last estimate of a fold of one asset with a tuning of its own."""
    twin = load_twin("motor_winding", overrides={key.replace("_", "."): str(value) for key, value in values.items()})
    log, j = Log.of(twin.model), ASSETS.index(asset)
    log.add("winding", np.arange(20.0), 40.0 + np.arange(20.0) + j)
    fold = twin.fold(log, policy=twin.policy)
    fold.advance()
    return fold.track.mean[-1]


def test_each_asset_has_the_estimates_of_its_own_tuning(tmp_path):
    table = "pump;R.winding [degC**2];Q.temperature\npump 3;4,5;0,2\nb;9;0,03\n"
    tunings = {"file": "tunings.csv", "asset": "pump", "values": {"b": {"R.winding": 16.0}}}
    found, _ = estimates(write(tmp_path, table, tunings=tunings))
    wanted = {
        "a": folded("a"),
        "b": folded("b", R_winding=16.0, Q_temperature=0.03),
        "pump 3": folded("pump 3", R_winding=4.5, Q_temperature=0.2),
    }
    assert {name: mean.tobytes() for name, mean in found.items()} == {k: v.tobytes() for k, v in wanted.items()}
    assert len({mean.tobytes() for mean in wanted.values()}) == 3


def test_the_page_of_an_asset_has_its_tuning(tmp_path):
    plan = load_fleet(write(tmp_path, tunings={"values": {"b": {"R.winding": 16.0}}}))
    page = load_twin("motor_winding", overrides=plan.history_of("b", tmp_path))
    assert page.tuning.get("R.winding") == 16.0
    assert load_twin("motor_winding", overrides=plan.history_of("a", tmp_path)).tuning.get("R.winding") != 16.0


def test_named_assets_are_listed_before_they_report_and_others_are_still_taken(tmp_path):
    found, said = estimates(write(tmp_path, tunings={"values": {"z": {"R.winding": 16.0}}}))
    assert list(found) == ["z", *ASSETS] and np.isnan(found["z"]).all() and NO_ASSET not in said


@cases(__file__, "fleet_tunings.csv")
def test_mistakes_are_one_line_with_its_place(table, more, words, tmp_path):
    path = write(tmp_path, table, **{"tunings": {"file": "tunings.csv"}, **json.loads(more)})
    assert re.search(words, error_of(ConfigError, load_fleet, path))
