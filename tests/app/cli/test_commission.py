"""`nisus commission`: what is normal, as lines of a YAML that are written, replaced and read again."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.cli.arguments import CommissionCommand
from app.cli.commission import commission_twin
from app.cli.main import main
from app.study.commission import lines
from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from app.twin.versions import write_section
from config.yaml_files import yaml_files
from estimators.diagnostics.episodes.baseline import Normal, baseline_of, lost_from
from estimators.errors import ConfigError
from estimators.fold import fold
from estimators.track import DIVERGED
from tests.cases import cases
from tests.skips import recorded
from tests.support import error_of

TWIN = """\
# A drive.
model: motor_winding

source:
  type: table
  files: drive.csv
  time: {column: t, unit: s}
  sensors: {winding: {columns: y}}
"""
SECTION = """\
baseline:                    # of another day
  winding: {bias: 0.5, scale: 2, correlation: 0.1,

    # a comment inside
    reached: {narrow: 4}}
"""
REST = """\
# What is drawn; this comment belongs to what follows.
view:
  window: 60
"""


def drive(folder, text=TWIN, noise=2.8, n=300):
    """A recording of readings, noisier than the model believes, and its twin."""
    y = 40.0 + np.random.default_rng(1).normal(0.0, noise, n)
    (folder / "drive.csv").write_text("t,y\n" + "".join(f"{k},{value:.3f}\n" for k, value in enumerate(y)))
    path = folder / "drive.yaml"
    path.write_bytes(text.encode())
    return str(path)


def test_what_is_printed_is_what_is_read_again(tmp_path, capsys):
    path = drive(tmp_path)
    assert load_twin(path).tuning.baseline is None
    assert commission_twin(CommissionCommand(path)) == 0
    printed = capsys.readouterr().out
    assert Path(path).read_text() == TWIN
    Path(path).write_text(TWIN + printed)
    baseline = load_twin(path).tuning.baseline
    assert baseline is not None and baseline[0, 1] > 1.2
    # Against white innovations, not against what was normal before: the same again.
    assert commission_twin(CommissionCommand(path)) == 0
    assert capsys.readouterr().out == printed
    # What is written stands in a file beside it, which replaces nothing that is written by hand.
    Path(path).write_text(TWIN)
    beside = tmp_path / "drive.baseline.yaml"
    for _ in range(2):
        assert commission_twin(CommissionCommand(path, write=True)) == 0
        assert (beside.read_text(), Path(path).read_text()) == (printed, TWIN)
    twin = load_twin(path)
    np.testing.assert_array_equal(twin.tuning.baseline, baseline)
    assert beside in twin.files and twin.text == f"{TWIN}\n{printed}"
    assert yaml_files(tmp_path) == [Path(path)]


@pytest.mark.parametrize(
    ("own", "beside", "said"),
    [
        ("baseline: {}\n", "baseline: {}\n", "drive.yaml:9: baseline stands here and in {}; keep one"),
        (
            "",
            "baseline: {}\ngate: 0.9\n",
            "{}:1: the file is {{baseline: a mapping, gate: 0.9}}; it must hold the section",
        ),
        ("", "text", "{}:1: the file is 'text'; it must hold the section `baseline` alone; write it anew"),
        ("", "\nbaseline:\n  tooth: {}\n", "{}:3: baseline.tooth is no sensor row of motor_winding"),
        ("", "baseline: {winding: {scale: 0}}", "{}:1: baseline.winding.scale is 0; it must be positive"),
    ],
)
def test_what_is_wrong_with_the_file_beside_it_is_one_line(tmp_path, monkeypatch, own, beside, said):
    path = drive(tmp_path, TWIN + own)
    (tmp_path / "drive.baseline.yaml").write_text(beside)
    monkeypatch.chdir(tmp_path)
    assert error_of(ConfigError, load_twin, path).startswith(said.format("drive.baseline.yaml"))


def test_bands_that_hold_too_little_are_told(tmp_path, capsys):
    path = drive(tmp_path, noise=3.0, n=1500)
    assert commission_twin(CommissionCommand(path)) == 0
    track = fold((twin := load_twin(path)).estimator, twin.model, twin.tuning, read_log(twin, None)[0])
    held = np.abs(track.innovation[:, 0]) < 1.96 * track.innovation_std[:, 0]
    told = f"winding lies in its 95 % band {100 * held.mean():.0f} % of the time"
    assert told in capsys.readouterr().err


def test_every_figure_comes_back(tmp_path):
    normals = {"winding": Normal(-0.25, 1.75, -0.125, {"narrow": 12.5, "shifted up": 3.0, "stuck": 100.0}, 12.5)}
    twin = load_twin(drive(tmp_path, TWIN + lines(normals)))
    np.testing.assert_array_equal(twin.tuning.baseline, baseline_of(twin.model, normals))
    assert twin.policy.diverged_nis == lost_from(normals) == 18.75


@pytest.mark.parametrize("end", ["\n", "\r\n"], ids=["unix", "windows"])
@pytest.mark.parametrize(
    "text",
    [TWIN + SECTION, TWIN + SECTION + REST, SECTION + TWIN, TWIN + SECTION.rstrip("\n"), TWIN + "\n" + SECTION],
    ids=["last", "amidst", "first", "unended", "apart"],
)
def test_the_rest_of_the_file_stays(tmp_path, text, end):
    """Byte for byte, with line ends as they are; and written again it is the same."""
    path = Path(drive(tmp_path, text.replace("\n", end)))
    assert commission_twin(CommissionCommand(str(path), write=True)) == 0
    written = path.read_bytes()
    first = written.index(b"baseline:")
    # Two lines of its own: the key, and a row with what was reached.
    own = b"".join(written[first:].splitlines(keepends=True)[:3])
    assert own.endswith(b"}}" + end.encode())
    before, section, after = text.partition(SECTION.rstrip("\n"))
    expected = (before if section else before + "\n", after.removeprefix("\n"))
    assert (written[:first], written[first + len(own) :]) == tuple(
        part.replace("\n", end).encode() for part in expected
    )
    load_twin(str(path))
    assert commission_twin(CommissionCommand(str(path), write=True)) == 0
    assert path.read_bytes() == written


def test_too_little_is_one_line(tmp_path):
    path = drive(tmp_path)
    text = error_of(ConfigError, commission_twin, CommissionCommand(path, duration=20.0, write=True))
    assert text == "no sensor row has 50 readings that were judged; commission on a longer recording"
    assert Path(path).read_text() == TWIN


def test_a_file_that_cannot_be_written_is_one_line(tmp_path):
    with pytest.raises(ConfigError, match=r"absent\.yaml: cannot be written: No such file or directory; "):
        write_section(tmp_path / "absent.yaml", "baseline", "baseline: {}\n")


@cases(__file__, "wrong_baselines.csv")
def test_a_wrong_section_is_one_line(tmp_path, section, said):
    path = drive(tmp_path, TWIN + "baseline:\n" + section)
    assert said in error_of(ConfigError, load_twin, path)


def test_a_twin_is_commissioned_against_white_innovations_whatever_was_normal_before(tmp_path):
    """Readings twenty times as noisy as R says are no longer diverged once that was normal; they are if told anew."""
    path = drive(tmp_path, TWIN + "baseline:\n  winding: {scale: 50}\n", noise=40.0)
    twin, log = recorded(path)

    def lost(tuning):
        return float(np.mean(fold(twin.estimator, twin.model, tuning, log, policy=twin.policy).health == DIVERGED))

    assert lost(twin.tuning) == 0.0 and lost(replace(twin.tuning, baseline=None)) > 0.5
    with pytest.raises(ConfigError, match="the twin is diverged or stale for"):
        commission_twin(CommissionCommand(path))


def test_a_log_that_its_own_detectors_contradict_is_rejected_and_a_forced_one_is_marked(tmp_path, capsys):
    path = drive(tmp_path)
    noise = np.random.default_rng(1).normal(0.0, 1.0, (2, 300))
    for y, said in (
        (40.0 + 4.0 * noise[0], r"winding contradicts its own log, its innovations are [12]\.\d times as large"),
        (40.0 + 2.0 * noise[0] + 0.01 * np.maximum(0.0, np.arange(300.0) - 150.0) ** 2, "winding contradicts its own"),
    ):
        (tmp_path / "drive.csv").write_text("t,y\n" + "".join(f"{k},{value:.3f}\n" for k, value in enumerate(y)))
        with pytest.raises(ConfigError, match=said) as problem:
            commission_twin(CommissionCommand(path, write=True))
        assert "--force" in str(problem.value) and Path(path).read_text() == TWIN
    assert commission_twin(CommissionCommand(path, write=True, force=True)) == 0
    twin = load_twin(path)
    assert twin.forced_baseline and twin.forced_baseline in str(problem.value)
    # What was contradicted once is shown by every fold from then on.
    capsys.readouterr()
    assert main(["fold", path]) == 0
    assert twin.forced_baseline[:60] in " ".join(capsys.readouterr().out.split())
