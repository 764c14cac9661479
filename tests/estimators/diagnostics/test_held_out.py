"""What a sensor that is held out shows, against innovations that are drawn as the others leave them."""

import numpy as np
import pytest

from estimators.diagnostics.held_out import LAST_MEASUREMENTS, MIN_MEASUREMENTS, Offset, offsets
from estimators.log import READING, Events
from estimators.models import MODELS
from estimators.track import HELD_OUT, USED, Track
from estimators.tuning import Tuning

MODEL = MODELS["motor_drive"]
YOKE = MODEL.sensor_names.index("yoke")
TUNING = Tuning.of(MODEL).set("use.yoke", False).set("R.yoke", 0.25)
P = 0.2  # variance of the prediction's error, which the readings of a while share


def shown(innovations, tuning=TUNING, verdict=HELD_OUT):
    n = len(innovations)
    track, t = Track.allocate(n, MODEL.nx, 0, 1), np.arange(n, dtype=np.int64) * 10**8
    track.verdict[:] = verdict
    track.innovation[:, 0], track.innovation_std[:, 0] = innovations, np.sqrt(P + 0.25)
    events = Events(t, t, np.full(n, READING, np.int8), np.full(n, YOKE, np.int32), np.zeros((n, 1)))
    return offsets(events, track, tuning)


def test_of_sensors_that_read_right_five_in_a_hundred_are_called_off():
    rng = np.random.default_rng(1)
    trials = 2000
    found = [shown(np.sqrt(P) * rng.normal() + 0.5 * rng.normal(size=60))[0] for _ in range(trials)]
    assert np.mean([item.beyond for item in found]) == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / trials))
    # The spread of their means, and what is allowed of it.
    assert found[0].allowed == pytest.approx(
        1.96 * np.std([item.offset for item in found]), rel=4 / np.sqrt(2 * trials)
    )


def test_a_shift_is_said_with_its_size_and_what_is_left_open():
    (found,) = shown(2.4 + 0.5 * np.random.default_rng(2).normal(size=500))
    assert found.sensor == "yoke" and found.beyond
    assert found.offset == pytest.approx(2.4, abs=4 * 0.5 / np.sqrt(LAST_MEASUREMENTS))
    allowed = 1.96 * np.sqrt(P + 0.25 / LAST_MEASUREMENTS)
    text = f"yoke, held out: 2.4 °C above the prediction of the other sensors, ±{allowed:.2g} °C expected"
    assert found.words == text


def test_only_the_last_readings_count_and_few_say_nothing():
    innovations = np.concatenate([np.full(1000, 50.0), np.full(LAST_MEASUREMENTS, -0.1)])
    (found,) = shown(innovations)
    assert found.offset == pytest.approx(-0.1) and not found.beyond
    assert found.words.startswith("yoke, held out: agrees with the other sensors (0.1 °C below the prediction, ")
    assert shown(np.ones(MIN_MEASUREMENTS - 1)) == []


def test_a_sensor_in_use_is_not_looked_at_and_one_without_others_says_so():
    assert shown(np.ones(50), Tuning.of(MODEL)) == []
    alone = TUNING.set("use.winding", False).set("use.tooth", False)
    assert "above the prediction of the model alone" in shown(np.full(50, 9.0), alone)[0].words


def test_readings_that_were_used_before_it_was_held_out_do_not_count():
    assert shown(np.full(40, 5.0), verdict=USED) == []
    assert Offset("yoke", "yoke", 1.0, 2.0, "1").words == (
        "yoke, held out: agrees with the other sensors (1 above the prediction, ±2 expected)"
    )
