"""A review folds what was folded: with the limits and the policy of the command line, and what was commissioned."""

import pytest

from app.cli.open_twin import recorded_twin
from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from app.views.recording.reader import read_recording
from app.views.recording.writer import write_recording
from estimators.diagnostics.episodes import episodes
from estimators.fold import Fold
from tests.support import assert_same

COMMISSIONED = """
model: motor_winding
estimator: kf
noise: {rate: {variance: 1.0e-4}}
sensors: {winding: {std: 1.5}}
source:
  type: simulator
  duration: 120
  seed: 3
  faults: [{kind: bias, sensor: winding, size: 30, start: 60, end: 90}]
commissioned:
  winding: {bias: 1.0, scale: 2.0, correlation: 0.3}
"""


def folded(twin, log, base=None):
    how = {"pairs": twin.pairs, "policy": twin.policy, "expected": twin.expected, "base": base}
    fold = Fold(twin.estimator, twin.model, twin.tuning, log, **how)
    fold.advance()
    return fold.track, episodes(fold)


@pytest.mark.parametrize(
    "overrides",
    [
        {},
        {"sensors.winding.range": "[-40, 55]"},
        {"prior.temperature.mean": "90", "Q.rate": "0.01", "commissioned": "{}"},
    ],
)
def test_a_review_judges_as_the_run_did(overrides, tmp_path):
    yaml = tmp_path / "motor.yaml"
    yaml.write_text(COMMISSIONED)
    twin = load_twin(yaml, overrides=overrides)
    log, _ = read_log(twin, None)
    track, told = folded(twin, log)
    write_recording(tmp_path / "run.rrd", twin, log, track)
    recorded = read_recording(tmp_path / "run.rrd")
    again = recorded_twin(recorded)
    assert told
    assert folded(again, log, recorded.base)[1] == told
    assert_same(folded(again, log, recorded.base)[0], track)
    # And what is compared does depend on what was left out before.
    if overrides or twin.tuning.baseline is not None:
        bare = load_twin(yaml, overrides={"commissioned": "{}"} if not overrides else {})
        assert folded(bare, log)[1] != told
