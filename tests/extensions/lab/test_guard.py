"""`nisus guard`: a planted regression is caught, reruns are silent, and what cannot be compared is said.

What the commands of the extension refuse is one line with the option or subject, its value and a remedy.
"""

import json
import re
import shlex
import shutil
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import yaml
from scipy.stats import chi2

from app.cli.arguments import FoldCommand as FoldArguments
from app.cli.fold import fold_twin
from app.cli.main import main
from app.extensions.lab.arguments import GuardCommand
from app.extensions.lab.guard import suite as guard_suite
from app.extensions.lab.guard.baseline import (
    ALLOWED_SHARE,
    MAX_ALLOWED,
    ComparedFigure,
    allowances,
    compare_figures,
    fold_figures,
    read_baseline,
)
from app.extensions.lab.guard.command import guard
from app.extensions.lab.guard.suite import GuardVerdict, keep_last, of_twin
from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from app.twin.versions import Settings, accept, keep, verdicts, version_text
from config.loader import TWINS, shipped
from config.tunings import load_version
from estimators.diagnostics.score import score
from estimators.errors import ConfigError
from estimators.events.batch import truth_of
from tests.cases import cases
from tests.support import folded

RECORDINGS = 10
PLANTED = 4


def twin_file(folder, name, seed, **changed):
    """A twin of its own: the linear one that ships, with another log."""
    text = yaml.safe_load((TWINS / "motor_winding.yaml").read_text())
    text["source"]["seed"] = seed
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump({**text, **changed}))
    return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("archive")
    for k in range(RECORDINGS):
        twin_file(folder, f"w{k}", 100 * k)
    assert guarded(folder, accept=True, note="as first recorded") == 0
    return folder


@pytest.fixture
def archive(recorded, tmp_path):
    """Ten recordings, with their scores recorded."""
    return shutil.copytree(recorded, tmp_path / "archive")


def guarded(folder, *twins, **more):
    return guard(GuardCommand(tuple(map(str, twins)), archive=folder, jobs=1, **more))


def kept(path, scale):
    """Accept a version of the twin whose R is scaled."""
    twin = load_twin(path)
    version = keep(twin, "planted", version_text(twin, Settings("kf", scaled(twin, scale))))
    accept(load_version(version), "")


def scaled(twin, scale):
    return twin.tuning.set("R.winding", scale * float(twin.tuning.r[0]))


def rmse(path, scale):
    """Of the temperature, over the logs that are guarded: the first, and those of the next two seeds."""
    found = []
    seed = load_twin(path).config.source.seed
    for k in range(3):
        twin = load_twin(path, overrides={"source.seed": str(seed + k)})
        log, _ = read_log(twin, None)
        track = folded("kf", twin.model, log, scaled(twin, scale)).track
        found.append(score(track, log.events, twin.model).states["temperature"].rmse)
    return np.array(found)


def worse_by(path, share):
    """The scale of R that makes the worst of the three RMSEs larger by a share."""
    before = rmse(path, 1.0)
    low, high = 1.0, 1e3
    assert np.max(rmse(path, high) / before) > 1.0 + share
    while high / low > 1.001:
        middle = np.sqrt(low * high)
        low, high = (low, middle) if np.max(rmse(path, middle) / before) > 1.0 + share else (middle, high)
    return high


def test_five_percent_in_one_of_ten_recordings_are_caught(archive, capsys):
    path = archive / f"w{PLANTED}.yaml"
    scale = worse_by(path, 0.05)
    assert np.max(rmse(path, scale) / rmse(path, 1.0)) == pytest.approx(1.05, abs=0.002)
    kept(path, scale)
    assert guarded(archive, junit=archive / "verdict.xml") == 1
    said = capsys.readouterr().out
    (row,) = re.findall(r"^ *w\d+ +planted +rmse\.temperature.*$", said, re.MULTILINE)
    # The log of 1.05.
    assert f"w{PLANTED}" in row and "+0.0488" in row
    assert set(re.findall(r"\bw\d+(?= )", said.partition("Better")[0])) == {f"w{PLANTED}"}
    suites = {suite.get("name"): suite for suite in ET.parse(archive / "verdict.xml").getroot()}
    assert len(suites) == RECORDINGS
    for name, suite in suites.items():
        failed = {case.get("name") for case in suite if case.find("failure") is not None}
        assert int(suite.get("failures")) == len(failed) and int(suite.get("tests")) == len(suite)
        assert ("rmse.temperature" in failed) == (name == f"w{PLANTED}") and (name == f"w{PLANTED}" or not failed)


def test_what_was_said_last_is_kept_beside_the_versions(archive, capsys):
    path = archive / f"w{PLANTED}.yaml"
    before = verdicts(path)
    assert [each["recording"] for each in before] == [path.stem] and verdicts(archive / "none.yaml") == []
    # A trial with other settings says nothing of what was accepted.
    assert guarded(None, path, set=("sensors.winding={std: 5.0}",)) == 1 and verdicts(path) == before
    kept(path, worse_by(path, 0.05))
    assert guarded(archive) == 1
    (worse,), (fine,) = verdicts(path), verdicts(archive / "w0.yaml")
    assert worse["version"] == "planted" and any(line.startswith("rmse.temperature was ") for line in worse["worse"])
    assert fine["version"] == "own" and fine["figures"] > 5 and not fine["worse"] and not fine["failure"]
    # Of one twin alone: what was said of the others stays; a file that was damaged is no obstacle.
    (archive / "w1.tunings" / "guard.json").write_text("{")
    assert verdicts(archive / "w1.yaml") == [] and guarded(None, archive / "w1.yaml") == 0
    assert verdicts(archive / "w1.yaml")[0]["recording"] == "w1" and verdicts(path) == [worse]


def test_a_figure_that_got_worse_is_kept_in_words(tmp_path):
    worse = ComparedFigure("rmse.temperature", 0.5, 0.6, 0.1, 0.01)
    keep_last(tmp_path / "winding.yaml", [GuardVerdict("winding", "own", [worse])])
    (said,) = verdicts(tmp_path / "winding.yaml")
    assert said["recording"] == "winding" and said["figures"] == 1
    assert said["worse"] == ["rmse.temperature was 0.5 and is 0.6: worse by 0.1, allowed 0.01"]


def test_reruns_are_silent(archive, capsys):
    for _ in range(2):
        assert guarded(archive) == 0
        assert "10 recordings, 70 figures: 0 worse, 0 better" in capsys.readouterr().out


def test_what_is_accepted_is_silent_from_then_on(archive, capsys):
    kept(archive / f"w{PLANTED}.yaml", 4.0)
    assert guarded(archive) == 1
    assert guarded(archive, accept=True, note="the sensor is worse than its data sheet") == 0
    assert f"w{PLANTED}" in capsys.readouterr().out
    assert guarded(archive) == 0
    known = read_baseline(archive / f"w{PLANTED}.guard.yaml")
    assert known.version == "planted" and known.accepted.note == "the sensor is worse than its data sheet"


@pytest.fixture
def drawn(tmp_path):
    """A filter that draws its members, with its scores recorded."""
    path = twin_file(tmp_path, "drawn", 1, estimator={"name": "etkf", "options": {"members": 12}})
    assert guarded(None, path, accept=True, note="as first recorded") == 0
    return path


def test_other_draws_are_chance_and_five_percent_are_not(drawn, monkeypatch, capsys):
    """Ten reruns with other members are silent; the same members with R scaled are not."""
    own = guard_suite._fold
    for k in range(1, 11):
        monkeypatch.setattr(
            guard_suite,
            "_fold",
            lambda twin, tuning, log, base, seed, k=k: own(twin, tuning, log, base, seed + 100 * k),
        )
        assert guarded(None, drawn) == 0
    monkeypatch.setattr(guard_suite, "_fold", own)
    assert guarded(None, drawn) == 0
    capsys.readouterr()
    assert guarded(None, drawn, set=("R.winding=6",)) == 1
    assert "log_likelihood" in capsys.readouterr().out


def test_chance_is_what_other_draws_make(drawn):
    """Other draws of a filter that is as good: the allowance has the size of a table's Student quantile."""
    known = read_baseline(of_twin(str(drawn)).reference)
    assert known.seeds == 4 and len(known.events) == 3
    rng = np.random.default_rng(5)
    logs = np.array([-1.0, 0.0, 3.0])
    worse = 0
    for _ in range(300):
        values = [np.exp(logs[:, None] + 0.1 * rng.standard_normal((3, 4))) for _ in range(2)]
        one, other = (with_values(known, each.ravel()) for each in values)
        (judged,) = compare_figures(one, other, simulated=True)
        worse += judged.worse
        # 3 logs of 4 folds have 9 degrees of freedom, two of them 18: quantiles of 1 - 1e-4 are 6.010 and 4.648.
        bad = [np.log(each) for each in values]
        s = [np.sqrt(np.mean(np.var(each, axis=1, ddof=1))) for each in (*bad, bad[1] - bad[0])]
        allowed = min(4.648 * np.sqrt((s[0] ** 2 + s[1] ** 2) / 12), 6.010 * s[2] / np.sqrt(12))
        assert judged.allowed == pytest.approx(allowed, rel=1e-3)
        assert judged.change == pytest.approx(np.mean(bad[1] - bad[0]))
    assert worse <= 1
    # Where the logs are others, the spread of their means counts: t of 4 degrees of freedom is 13.03.
    (judged,) = compare_figures(
        one, other.model_copy(update={"sums": tuple(1.0 + each for each in known.sums)}), simulated=True
    )
    means = [np.log(each).mean(axis=1) for each in values]
    spread = np.sqrt(sum(np.var(each, ddof=1) / 3 for each in means))
    assert judged.allowed == pytest.approx(13.03 * spread, rel=1e-3)


def with_values(known, values):
    section = known.figures["rmse.temperature"].model_copy(update={"values": tuple(values), "allowed": (1e-6,) * 12})
    return known.model_copy(update={"figures": {"rmse.temperature": section}})


def test_what_is_allowed_is_a_tenth_of_the_standard_error(tmp_path):
    """Log-likelihoods of a consistent Kalman filter are independent: σ / √N, which 20 blocks tell to 16 %."""
    path = twin_file(tmp_path, "long", 3)
    ratios = []
    for seed in range(20):
        twin = load_twin(path, overrides={"source.seed": str(seed)})
        log, _ = read_log(twin, None)
        fold = folded("kf", twin.model, log, twin.tuning)
        each = fold.track.log_likelihood[fold.track.dof > 0]
        assert fold_figures(fold)["log_likelihood"] == pytest.approx(each.mean(), rel=1e-12)
        allowed = allowances(fold)["log_likelihood"]
        ratios.append(allowed / (ALLOWED_SHARE * np.std(each, ddof=1) / np.sqrt(each.size)))
    # The sum of 20 squared ratios of 19 degrees of freedom each, roughly; blocks of unequal counts loosen it.
    low, high = chi2.ppf([0.0005, 0.9995], 20 * 19) / (20 * 19)
    assert 0.9 * low < np.mean(np.square(ratios)) < 1.1 * high


def test_no_figure_may_change_by_more_than_two_percent(tmp_path):
    path = twin_file(tmp_path, "short", 3)
    twin = load_twin(path)
    log, _ = read_log(twin, 30.0)
    fold = folded("kf", twin.model, log, twin.tuning)
    found = allowances(fold)
    assert all(allowed <= MAX_ALLOWED for name, allowed in found.items() if name.startswith(("rmse", "nis", "log")))
    # Two of 30 errors may leave the band.
    assert found["coverage.rate"] == pytest.approx(2 / len(truth_of(log.events, 1)[0]), rel=1e-12)


def test_recordings_of_a_folder(tmp_path, capsys):
    """An .rrd is folded with its twin as it is now; without it, as it holds it."""
    (tmp_path / "twins").mkdir()
    folder = tmp_path / "archive"
    folder.mkdir()
    path = twin_file(tmp_path / "twins", "winding", 7)
    fold_twin(FoldArguments(str(path), out=folder / "monday.rrd", json=True))
    told = json.loads(capsys.readouterr().out)
    assert guarded(folder, accept=True, note="first") == 0
    known = read_baseline(folder / "monday.guard.yaml")
    assert known.figures["rmse.temperature"].values == pytest.approx((told["rmse"]["temperature"],), rel=1e-9)
    assert known.figures["log_likelihood"].values[0] * told["nis"]["n"] == pytest.approx(
        told["log_likelihood"], rel=1e-9
    )
    assert guarded(folder) == 0
    kept(path, 4.0)
    assert guarded(folder) == 1
    shutil.rmtree(tmp_path / "twins")
    assert guarded(folder) == 0


def test_a_recording_that_is_another_is_said(tmp_path, capsys):
    rows = "".join(f"{k},{40 + np.sin(k / 9)}\n" for k in range(120))
    (tmp_path / "drive.csv").write_text("t,y\n" + rows)
    source = {
        "type": "table",
        "files": "drive.csv",
        "time": {"column": "t", "unit": "s"},
        "sensors": {"winding": {"columns": "y"}},
    }
    path = twin_file(tmp_path, "drive", 1)
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), "source": source}))
    assert guarded(None, path, accept=True, note="first") == 0
    assert guarded(None, path) == 0
    (tmp_path / "drive.csv").write_text("t,y\n" + rows.replace("\n7,", "\n7,1"))
    capsys.readouterr()
    assert guarded(None, path) == 2
    assert "drive: its log is another one: 120 events were folded, 120 are now; if that is intended" in said(capsys)


def said(capsys):
    """What was printed, as one line."""
    return " ".join(capsys.readouterr().out.split())


def test_what_is_absent_is_an_error_where_everything_must_be_there(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("NISUS_DATA", str(tmp_path / "nowhere"))
    monkeypatch.delenv("CI", raising=False)
    assert guarded(None, "motor_bench", junit=tmp_path / "a.xml") == 0
    assert "Missing, skipped motor_bench: " in said(capsys)
    assert ET.parse(tmp_path / "a.xml").getroot().get("skipped") == "1"
    monkeypatch.setenv("CI", "true")
    assert guarded(None, "motor_bench", junit=tmp_path / "a.xml") == 2
    assert "Missing, an error with CI=true motor_bench: " in said(capsys)
    assert ET.parse(tmp_path / "a.xml").getroot().get("errors") == "1"


def test_a_twin_without_truth_is_guarded_by_sensors_held_out(tmp_path, capsys):
    """Each in turn is predicted by the others."""
    twin = load_twin("motor_can")
    log, _ = read_log(twin, 60.0)
    fold = folded(twin.estimator, twin.model, log, twin.tuning.set("use.yoke", False), policy=twin.policy)
    expected = score(fold.track, log.events, twin.model, gate=twin.tuning.gate).held_out["yoke"].rmse
    text = yaml.safe_load((TWINS / "motor_can.yaml").read_text())
    del text["source"]["truth"], text["source"]["asset"]
    for key in ("dbc", "recording"):
        text["source"][key] = str((TWINS / text["source"][key]).resolve())
    path = tmp_path / "drive.yaml"
    path.write_text(yaml.safe_dump(text))
    assert guarded(None, path, accept=True, note="first") == 0
    known = read_baseline(tmp_path / "drive.guard.yaml")
    assert {"rmse.yoke", "rmse.tooth", "rmse.winding", "coverage.yoke"} <= set(known.figures)
    assert known.figures["rmse.yoke"].values[0] == pytest.approx(expected, rel=0.5)


@cases(__file__, "wrong_scores.csv")
def test_recorded_scores_that_are_wrong_are_said_with_their_line(tmp_path, capsys, old, new, problem):
    path = twin_file(tmp_path, "w", 1)
    assert guarded(None, path, accept=True, note="first") == 0
    file = tmp_path / "w.guard.yaml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    capsys.readouterr()
    assert guarded(None, path) == 2
    assert re.search(problem, said(capsys))


def test_bad_requests(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("CI", raising=False)
    path = twin_file(tmp_path, "w", 1)
    with pytest.raises(ConfigError, match="--accept: .*--note TEXT"):
        guarded(None, path, accept=True)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="holds no recording"):
        guarded(tmp_path / "empty")
    assert guarded(None, path) == 0
    assert "w: no figures are recorded; `nisus guard" in said(capsys)
    monkeypatch.setenv("CI", "true")
    assert guarded(None, path) == 2
    assert main(["guard", "nobody"]) == 2


def test_a_figure_that_is_gone_is_worse(archive):
    known = read_baseline(archive / "w0.guard.yaml")
    fewer = known.model_copy(update={"figures": {k: v for k, v in known.figures.items() if k != "rmse.rate"}})
    judged = {each.figure: each for each in compare_figures(known, fewer, simulated=True)}
    assert judged["rmse.rate"].worse and not any(each.worse for name, each in judged.items() if name != "rmse.rate")


def test_what_ships_is_guarded():
    """All but the field of a million cells, of which to begin alone takes longer than the others together."""
    missing = {name for name in shipped() if not of_twin(name).reference.is_file()}
    assert missing == {"thermal_field_large"}
    for name in set(shipped()) - missing:
        known = read_baseline(of_twin(name).reference)
        assert known.version == "own" and known.estimator == load_twin(name).estimator
        assert any(figure.startswith("rmse.") for figure in known.figures)


def test_a_recording_that_cannot_be_read_leaves_the_others(archive, capsys):
    (archive / "broken.rrd").write_bytes(b"no recording" * 99)
    assert main(["guard", "--archive", str(archive), "--jobs", "1"]) == 2
    said = capsys.readouterr().out
    assert f"{RECORDINGS} recordings," in said and "broken: " in said and "broken.rrd: cannot be read" in said


@cases(__file__, "bad_arguments.csv")
def test_a_wrong_argument_is_one_line(said, command, nisus, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(guard_suite, "guard_log", lambda *_: pytest.fail("it was folded"))
    assert said in nisus.refuses(*shlex.split(command))
    assert not list(tmp_path.iterdir())
