"""Tuning versions: kept, listed, applied, accepted, named in what comes out; and what is wrong with one is said."""

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
import yaml

from app.cli.arguments import FoldCommand
from app.cli.fold import fold_twin
from app.cli.open_twin import recorded_twin
from app.engine.load_version import load_into
from app.record.reader import read_recording
from app.twin.log_reader import read_log
from app.twin.tuning_yaml import tuning_yaml, with_tuning
from app.twin.twin import load_twin, restore_twin, with_held
from app.twin.versions import Settings, accept, apply_tuning, keep, last_accepted, listing, version_text
from config.loader import TWINS, shipped
from config.tunings import find_version, folders, load_version, version_files
from estimators.errors import ConfigError
from estimators.fit.uncertainty import ParameterWidths
from estimators.registry import ESTIMATORS
from tests.app.web.page.browsed import running, settled
from tests.cases import cases


def same(a, b):
    for name in ("q", "r", "p", "used", "baseline"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert (a.gate, a.gate_kind, a.reopen, a.seed) == (b.gate, b.gate_kind, b.reopen, b.seed)


SECTIONS = ("estimator", "filters", "parameters", "noise", "sensors", "gate")


def pasted(twin, estimator, tuning):
    """The twin of a file that has these settings in place of its own."""
    return pasted_text(twin, tuning_yaml(twin.config, estimator, tuning))


def pasted_text(twin, text):
    given, own = yaml.safe_load(text), yaml.safe_load(twin.text)
    assert set(given) <= set(SECTIONS)
    rest = yaml.safe_dump({key: value for key, value in own.items() if key not in SECTIONS})
    return restore_twin(f"{text}{rest}", twin.path)


def applied(twin, estimator, tuning, **more):
    """The same twin under a version with these settings."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tried.yaml"
        path.write_text(version_text(twin, Settings(estimator, tuning, **more)), encoding="utf-8")
        return load_twin(twin.path, overrides={"tuning": str(path)})


def kept(twin, name="quiet", tuning=None):
    """Keep a version, by default one that believes its sensor more."""
    tuning = tuning or twin.tuning.set("R.winding", 0.5)
    return keep(twin, name, version_text(twin, Settings("kf", tuning)))


either = pytest.mark.parametrize("back_of", [pasted, applied])


@pytest.mark.parametrize(
    ("spread", "said"), [(None, ""), (0.04, "as before: one log, one specimen"), (0.05, "between the logs")]
)
def test_the_covariance_of_a_fit_and_its_range_come_back_and_are_considered(spread, said, tmp_path):
    """A version has all of it; in the twin's file a `std` that was there is that between specimens."""
    path = tmp_path / "motor.yaml"
    text = (TWINS / "motor_can.yaml").read_text(encoding="utf-8")
    own = yaml.safe_load(text)
    own["valid"] = {"coolant": {"min": 0, "max": 50}}
    own["parameters"] = (own.get("parameters") or {}) | {
        "magnet_ambient": {"value": 0.4, "std": "10 %", "widen": {"coolant": {"per": 10, "by": "20 %"}}}
    }
    path.write_text(yaml.safe_dump(own), encoding="utf-8")
    twin = load_twin(path)
    names = ("winding_tooth", "yoke_coolant", "magnet_ambient")
    R = np.array([[1.0, 0.123456789, 0.0], [0.123456789, 1.0, -0.99999], [0.0, -0.99999, 1.0]])
    R[0, 1:] = R[1:, 0] = 0.123456789, -0.123456
    std, prior = np.array([0.001, 0.002, 0.003]), np.array([0.01, 0.02, 0.04])
    ends = {"coolant": (20.0, 61.5), "speed": (0.0, 300.0)}
    widths = ParameterWidths(names, std.copy(), R.copy(), prior, 4.0, ends, np.array([*prior[:2], spread or 0.04]))
    if spread is None:
        found = applied(twin, "ekf", twin.tuning, widths=widths)
    else:
        assert f"; std of magnet_ambient {said}; the" in apply_tuning(twin, "ekf", twin.tuning, widths=widths)
        found = load_twin(path)
        R[2, :2] = R[:2, 2] = 0.0
        std[2] = spread
    held = with_held(found).model
    assert held.considered == 0
    assert found.model.state_names[held.nx :] == (*(f"{name}_deviation" for name in names), "magnet_ambient_outside")
    np.testing.assert_allclose(found.model.prior_cov[held.nx : -1, held.nx : -1], R * np.outer(std, std), rtol=1e-7)
    ranges = {item.name: item.fitted for item in found.model.inputs}
    assert ranges["coolant"] == (20.0, 61.5) and ranges["speed"] is None


@either
@pytest.mark.parametrize("name", shipped())
def test_a_twin_that_ships_comes_back(name, back_of):
    twin = load_twin(name)
    back = back_of(twin, twin.estimator, twin.tuning)
    assert back.estimator == twin.estimator
    same(back.tuning, twin.tuning)
    np.testing.assert_array_equal(back.model.prior_mean, twin.model.prior_mean)
    for other in ESTIMATORS:
        assert back.options_of(other) == twin.options_of(other)
    assert back.config == twin.config.model_copy(update={key: getattr(back.config, key) for key in SECTIONS})


@either
def test_what_was_turned_comes_back(back_of):
    twin = load_twin("motor_can")
    tuning = twin.tuning.set("Q.winding", 1e-7).set("R.yoke", 0.1 + 0.2).set("use.tooth", False).set("gate", 0.99)
    tuning = tuning.set("gate.kind", "soft").set("gate.reopen", None).set("p.iron_magnet", 0.31)
    tuning = tuning.with_options({"adapt": 1.0, "memory": 50.0})
    back, entry = back_of(twin, "ekf", tuning), ESTIMATORS["ekf"]
    same(back.tuning, tuning)
    assert entry.complete(dict(back.tuning.options)) == entry.complete(dict(tuning.options))
    assert back_of(twin, "ekf", twin.tuning.set("gate", None)).tuning.gate is None


@pytest.mark.parametrize("name", shipped())
def test_changed_values_take_their_places_in_the_file_and_comments_stay(name):
    """Standard deviations are written to six digits; a family of sensors has one place for all its members."""
    twin = load_twin(name)
    tuning = replace(twin.tuning, q=2.0 * twin.tuning.q, r=3.0 * twin.tuning.r).set("gate", 0.97)
    before, after = (tuning_yaml(twin.config, twin.estimator, each) for each in (twin.tuning, tuning))
    text = with_tuning(twin.text, before, after)
    back = restore_twin(text, twin.path)
    for key in ("q", "r", "p", "used"):
        np.testing.assert_allclose(getattr(back.tuning, key), getattr(tuning, key), rtol=1e-5)
    assert back.tuning.gate == 0.97 and back.estimator == twin.estimator
    assert back.config == twin.config.model_copy(update={key: getattr(back.config, key) for key in SECTIONS})
    assert with_tuning(twin.text, before, before) == twin.text


def test_values_without_a_place_replace_their_section():
    text = "# mine\nmodel: motor_winding\nnoise: {temperature: {std: 0.1}}  # by hand\nsensors:\n" + (
        "  winding:\n    std: {value: 2, from: 1, to: 9}  # data sheet\n# last\nsource: {type: can}\n"
    )
    before, after = (
        f"estimator: {name}\nnoise:\n  temperature: {{variance: {q}}}\n  rate: {{variance: 1}}\n"
        f"sensors:\n  winding: {{variance: {{value: {r}, from: 1, to: 81}}}}\n"
        for name, q, r in (("kf", 0.01, 4), ("ekf", 0.04, 16))
    )
    found = with_tuning(text, before, after)
    assert found == text.replace("std: 0.1", "std: 0.2").replace("value: 2,", "value: 4,") + "\nestimator: ekf\n"
    found = with_tuning(text, before, after.replace("rate: {variance: 1}", "rate: {variance: 2}"))
    assert "noise:\n  temperature: {variance: 0.04}\n  rate: {variance: 2}\n" in found and "# data sheet" in found


def test_a_value_that_an_alias_shares_is_written_for_each():
    text = "model: motor_can\nsensors:\n  yoke: &same {std: 0.5}\n  tooth: *same\n"
    before, after = (
        f"sensors:\n  yoke: {{variance: {yoke}}}\n  tooth: {{variance: {tooth}}}\n"
        for yoke, tooth in ((0.25, 0.25), (1.0, 4.0))
    )
    found = with_tuning(text, before, after)
    assert found == "model: motor_can\n" + after


def test_words_stand_for_choices():
    twin = load_twin("motor_can")
    tuning = twin.tuning.set("use.tooth", False).set("gate.reopen", None).with_options({"adapt": 1.0})
    text = tuning_yaml(twin.config, "ekf", tuning)
    assert "adapt: R" in text and "use: false" in text and "reopen: never" in text


def test_a_prior_comes_back():
    twin = load_twin("motor_can")
    mean = 55.0 + np.arange(twin.model.nx)
    model = applied(twin, "ekf", twin.tuning, prior=(mean, np.diag(mean**2))).model
    assert np.array_equal([model.prior_mean, model.prior_std], [mean, mean])


def test_limits_of_a_sensor_stay_with_it():
    twin = load_twin("motor_can", overrides={"sensors.yoke.range": "[-40, 180]", "sensors.yoke.rate": "5"})
    back = pasted(twin, "ekf", twin.tuning.set("R.yoke", 2.0))
    yoke, before = back.config.sensors["yoke"], twin.config.sensors["yoke"]
    assert (yoke.range, yoke.rate) == (before.range, before.rate) and yoke.range is not None
    assert back.tuning.get("R.yoke") == 2.0


def test_options_of_the_first_filter_are_kept_for_another():
    twin = load_twin("motor_can", overrides={"estimator": "{name: enkf, options: {members: 77}}"})
    back = pasted(twin, "ukf", twin.tuning.with_options({"alpha": 0.5}))
    assert back.estimator == "ukf" and back.options_of("ukf") == {"alpha": 0.5}
    assert back.options_of("enkf") == {"members": 77.0}


def test_how_long_errors_last_stands_beside_their_size():
    given = {
        "noise.winding": "{variance: 0.01, correlation_time: 2 min}",
        "sensors.yoke.error": "{std: 0.7, correlation_time: 40}",
    }
    twin = load_twin("motor_can", overrides=given)
    same(pasted(twin, "ekf", twin.tuning).tuning, twin.tuning)
    tuning = twin.tuning.set("p.winding_disturbance_time", 33.3).set("p.yoke_error_time", 11.0)
    tuning = tuning.set("Q.yoke_error", 0.1 + 0.2).set("Q.winding", 0.003)
    same(pasted(twin, "ekf", tuning).tuning, tuning)
    assert "disturbance_time" not in (text := tuning_yaml(twin.config, "ekf", tuning)) and "error_time" not in text
    # A correlation time that is estimated has no place in the tuning: the file's stays.
    twin = load_twin(
        "motor_can", overrides={**given, "parameters.winding_disturbance_time": "{std: 30, role: estimated}"}
    )
    assert "correlation_time: 120}" in tuning_yaml(twin.config, "ekf", twin.tuning)


def test_what_a_version_does_not_say_stays_the_twins(winding):
    """A limit that was added after the version was kept holds with it."""
    twin = load_twin(winding)
    path = kept(twin)
    winding.write_text(winding.read_text().replace("winding: {variance: 4}", "winding: {variance: 4, range: [0, 200]}"))
    back = load_twin(winding, overrides={"tuning": "quiet"})
    assert path == winding.with_name("winding.tunings") / "quiet.yaml"
    assert back.tuning.get("R.winding") == 0.5 and back.config.sensors["winding"].range == ((0.0, 200.0),)


def test_the_asset_stays_as_it_is(winding):
    """A simulator draws from the noise that the twin's file believes; what a version assumes is no other asset."""
    twin = load_twin(winding)
    kept(twin, tuning=twin.tuning.set("R.winding", 0.5).set("Q.rate", 1.0))
    said = [read_log(load_twin(winding, overrides={"tuning": name}), None)[0] for name in ("own", "quiet")]
    for a, b in zip(*(log.events for log in said), strict=True):
        np.testing.assert_array_equal(a, b)


def test_another_filter_and_no_options():
    """The options of the file's own filter are kept for it; a version without options has none."""
    twin = load_twin("lorenz63")
    other = applied(twin, "ekf", twin.tuning.with_options({}))
    assert other.estimator == "ekf" and dict(other.tuning.options) == {}
    assert other.options_of(twin.estimator) == twin.options_of(twin.estimator)
    bare = applied(twin, twin.estimator, twin.tuning.with_options({}))
    assert dict(bare.tuning.options) == {}


def test_the_command_line_has_the_last_word(winding):
    kept(load_twin(winding))
    for key, value in (("R.winding", 3.0), ("sensors.winding.variance", 3.0)):
        back = load_twin(winding, overrides={"tuning": "quiet", key: str(value)})
        assert back.tuning.get("R.winding") == value and back.tuning.name == "quiet*"
    assert load_twin(winding, overrides={"tuning": "own"}).tuning.name == "own"
    assert load_twin(winding).tuning.set("R.winding", 3.0).set("R.winding", 4.0).name == "own*"


def test_kept_listed_compared_accepted(winding, nisus):
    nisus("tunings", winding, "--save", "quiet", "--set", "R.winding=0.5", "--note", "a ‘quieter’ sensor")
    refused = nisus.refuses("tunings", winding, "--save", "quiet")
    assert "quiet.yaml: there is a version of that name; choose another name" in refused
    nisus("tunings", winding, "--save", "loud", "--set", "R.winding=9")
    listed = {item["name"]: item for item in nisus("tunings", winding, "--json").json}
    assert set(listed) == {"own", "quiet", "loud"}
    assert listed["own"]["holds"] and listed["quiet"]["note"] == "a ‘quieter’ sensor"
    # What the fold says of itself.
    told = nisus("fold", winding, "--tuning", "quiet", "--json").json
    assert told["tuning"] == "quiet"
    scores = listed["quiet"]["scores"]
    assert scores["nis"] == pytest.approx(told["nis"]["mean"] / told["nis"]["dof"], rel=1e-7)
    assert scores["rmse.temperature"] == pytest.approx(told["rmse"]["temperature"], rel=1e-7)
    assert scores["coverage.rate"] == pytest.approx(told["coverage"]["rate"], rel=1e-7)
    assert scores["log_likelihood"] * told["nis"]["n"] == pytest.approx(told["log_likelihood"], rel=1e-7)

    compared = nisus("tunings", winding, "quiet", "loud", "--json").json
    assert compared["entries"] == [{"key": "R.winding", "values": [0.5, 9.0]}]
    before = find_version(winding, "quiet")
    nisus("tunings", winding, "--accept", "quiet", "--note", "it is")
    version = find_version(winding, "quiet")
    assert last_accepted([before, version]) is version and version.head.accepted.note == "it is"
    assert version.head.model_copy(update={"accepted": None}) == before.head
    assert {**version.data, "version": 0} == {**before.data, "version": 0}
    assert "quiet *" in nisus("tunings", winding).out


def test_the_last_that_was_accepted_holds(winding, monkeypatch):
    twin = load_twin(winding)
    for k, name in enumerate(("b", "a")):
        path = kept(twin, name)
        monkeypatch.setattr("app.twin.versions.now", lambda k=k: f"2026-11-2{k}T00:00:00Z")
        accept(load_version(path), "")
    assert [item["name"] for item in listing(twin) if item["holds"]] == ["a"]


def test_versions_of_a_twin_that_ships_go_to_the_users_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    twin = load_twin("motor_winding")
    path = kept(twin)
    assert path == tmp_path / "nisus" / "tunings" / "motor_winding" / "quiet.yaml"
    assert version_files(twin.path)["quiet"] == path and folders(twin.path)[1].parent.name == "tunings"


def test_the_name_is_in_every_row_and_recording(winding, tmp_path):
    text = winding.read_text()
    twin = load_twin(winding)
    tuning = replace(twin.tuning.set("Q.rate", 1e-4))
    settings = Settings("kf", tuning, prior=(twin.model.prior_mean, np.diag([25, 0.49])))
    keep(twin, "tried", version_text(twin, settings) + "baseline:\n  winding: {bias: 0.25}\n")
    fold_twin(FoldCommand(str(winding), tuning="tried", out=tmp_path / "a.parquet"))
    assert set(pyarrow.parquet.read_table(tmp_path / "a.parquet").column("tuning").to_pylist()) == {"tried"}
    fold_twin(FoldCommand(str(winding), tuning="tried", out=tmp_path / "a.rrd"))
    # The recording holds the version whole: it is reviewed when that is gone.
    shutil.rmtree(folders(winding)[0])
    back = recorded_twin(read_recording(tmp_path / "a.rrd"))
    assert back.tuning.name == "tried" and back.text == text
    assert back.model.prior_std[back.model.state_names.index("rate")] == 0.7
    assert back.tuning.baseline[0, 0] == 0.25


@cases(__file__, "wrong_versions.csv")
def test_what_is_wrong_is_said_with_its_line(winding, old, new, said):
    twin = load_twin(winding)
    given = Settings("kf", twin.tuning, note="tried", scores={"nis": 1.0})
    text = version_text(twin, given)
    assert old in text
    folder = folders(winding)[0]
    folder.mkdir()
    (folder / "tried.yaml").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigError, match=said):
        load_twin(winding, overrides={"tuning": "tried"})


@pytest.mark.parametrize(
    ("text", "said"), [("", r":1: the file is empty; a tuning version"), ("- 1\n", r":1: the file is \[1\]; a tuning")]
)
def test_what_is_no_version_is_said(tmp_path, text, said):
    path = tmp_path / "tried.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=said):
        load_version(path)


def test_a_version_that_is_not_there(winding, tmp_path):
    kept(load_twin(winding))
    with pytest.raises(ConfigError, match=r"--tuning quite: winding has no such version; did you mean quiet; see"):
        load_twin(winding, overrides={"tuning": "quite"})
    with pytest.raises(ConfigError, match=r"no\.yaml: there is no such file; check the path, or see `nisus tunings"):
        load_twin(winding, overrides={"tuning": str(tmp_path / "no.yaml")})


@pytest.mark.parametrize("name", ["own", "", "a/b", ".a", "a b", "x" * 61, "a.yaml"])
def test_a_name_that_is_none(winding, name):
    with pytest.raises(ConfigError, match="the version's name is"):
        kept(load_twin(winding), name)


def test_one_that_cannot_be_read_is_listed_beneath_the_others(winding, nisus):
    nisus("tunings", winding, "--save", "good")
    (folders(winding)[0] / "bad.yaml").write_text("- 1\n")
    table, beneath = nisus("tunings", winding).out.split("Cannot be read")
    assert [line.split()[0] for line in table.splitlines()[-3:-1]] == ["own", "good"]
    assert "bad.yaml:1: the file is [1]; a tuning version is a mapping" in " ".join(beneath.split())


@pytest.mark.parametrize(
    ("name", "own_count", "version", "count"),
    [
        ("battery_panasonic", 11 + 3, "held", 0),
        ("battery_dmegc", 11 + 3, "held", 0),
        ("motor_bench", 17 + 4, "held", 0),
        ("motor_bench", 17 + 4, "fitted", 17 + 4),
    ],
)
def test_a_version_that_ships_changes_widths_and_not_the_values_of_its_twin(name, own_count, version, count):
    """Not those of the model: a twin may have other values of it. A parameter whose width grows counts twice."""
    own, found = load_twin(name), load_twin(name, overrides={"tuning": version})
    assert (own.model.considered, found.model.considered) == (own_count, count)
    np.testing.assert_array_equal(found.tuning.p, own.tuning.p)
    text = version_text(found, Settings("ekf", found.tuning))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "again.yaml"
        path.write_text(text, encoding="utf-8")
        again = load_twin(name, overrides={"tuning": str(path)})
    assert again.model.states == found.model.states and again.model.considered == found.model.considered


def test_a_version_that_considers_parameters_is_loaded_while_the_twin_runs(tmp_path):
    """It adds states that nobody sees, and widens bands: that of the magnet most, which no sensor measures."""
    with running("motor_joint", **{"source.duration": "60"}) as session:
        engine = session.engine
        before = engine.rows(engine.end() - 1, engine.end()).track.std[-1]
        std = np.array([0.1])
        widths = ParameterWidths(("magnet_ambient",), std, np.eye(1), std, 1.0, {}, std)
        path = tmp_path / "wide.yaml"
        path.write_text(version_text(engine.twin, Settings("ekf", engine.twin.tuning, widths=widths)), encoding="utf-8")
        load_into(engine, str(path))
        settled(engine, 1)
        assert engine.status().tuning.name == "wide" and engine.model.considered == 1
        after = engine.rows(engine.end() - 1, engine.end()).track.std[-1]
        assert np.all(after > before) and np.argmax(after / before) == 3
