"""When what the innovations say of R and Q is not to be taken: proved by folds with it taken."""

import numpy as np
import pytest

from app.cli.prepare import prepare
from app.derive.sweep import doubts
from estimators.diagnostics.innovations import SensorNoise, sensor_noise
from estimators.diagnostics.score import score
from estimators.fold import Fold
from tests.cases import cases
from tests.skips import recorded

NOISES = {
    "white": SensorNoise(0.3, 0.01, 2000, 0.01, 0.4),
    "slow": SensorNoise(0.001, 0.0001, 2000, 0.6, 0.0),
    "alternating": SensorNoise(0.5, 0.01, 2000, -0.3, 0.0),
}


WHITE_NOISE = {
    "sensors.voltage": "{std: 0.06}",
    "sensors.temperature": "{std: 0.06}",
    "noise.temperature": "{variance: 1e-4}",
    "source.sensors.temperature.repeats": "keep",
}
"""The battery without errors that last, as whoever has not found them would set it."""


def said(name, **overrides):
    """What the innovations of a twin say of each R once it is taken, and its fits before and after."""
    twin, log = recorded(name, **overrides)
    prepare(twin)

    def folded(tuning):
        fold = Fold(twin.estimator, twin.model, tuning, log, policy=twin.policy)
        fold.advance()
        return fold

    before = folded(twin.tuning)
    noise = sensor_noise(before.track, log.events, twin.tuning)
    taken = twin.tuning
    for row, found in noise.items():
        taken = taken.set(f"R.{row}", found.variance)
    after = folded(taken)
    fits = [score(fold.track, log.events, twin.model).states for fold in (before, after)]
    again = sensor_noise(after.track, log.events, taken)
    return {f"R.{row}": found for row, found in again.items()}, *fits


def test_on_a_recording_whose_error_lasts_it_would_spoil_the_twin_and_is_doubted(data):
    """A coverage of 95 % before and far less after; so neither R of this twin is offered."""
    data("battery_panasonic_18650pf", "25degC_US06.mat")
    noise, before, after = said("battery_panasonic", overrides={**WHITE_NOISE, "tuning": "held"})
    assert before["soc"].coverage > 0.93 and after["soc"].coverage < 0.8
    assert after["soc"].rmse > 1.3 * before["soc"].rmse
    found = doubts(noise, 0.4)
    assert set(found) == {"R.voltage", "R.temperature", "Q"}
    assert found["R.voltage"].startswith("the innovations are correlated (+0.")
    assert found["R.voltage"].endswith("their size does not determine R")


def test_where_the_innovations_are_white_it_does_no_harm_and_is_offered():
    noise, before, after = said("motor_can")
    assert doubts(noise, 2.0) == {}
    for name in before:
        assert after[name].rmse == pytest.approx(before[name].rmse, rel=0.02)
        assert after[name].coverage == pytest.approx(before[name].coverage, abs=0.01)


@cases(__file__, "doubts.csv")
def test_all_of_q_is_doubted_where_it_would_make_the_correlation_worse(noise, level, doubted):
    """Where innovations that are too large are alike from one to the next, a larger Q would mend both."""
    found = doubts({"R.y": NOISES[noise]}, float(level) if level else None)
    assert sorted(found) == sorted(doubted.split())


def test_a_doubt_gives_the_correlation_beside_what_chance_allows():
    text = doubts({"R.y": NOISES["slow"]}, None)["R.y"]
    assert f"+0.60 with the next, where chance allows ±{2 / np.sqrt(2000):.2f}" in text
