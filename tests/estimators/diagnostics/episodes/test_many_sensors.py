"""Dropouts of more sensors than have a bit of their own in the track: each is named, and no other."""

from dataclasses import replace

import numpy as np

from estimators.diagnostics.detectors import SENSOR_FLAGS
from estimators.diagnostics.episodes import episodes
from estimators.log import Log
from tests.models import level_model
from tests.support import SECOND, folded

COUNT = SENSOR_FLAGS + 12
GONE = {3: 40, SENSOR_FLAGS + 5: 60}
"""Sensors that drop out, with the second of their last measurement."""

BY_CHANCE = {5: 40, SENSOR_FLAGS + 7: 20, SENSOR_FLAGS + 8: -1}
"""Those that cannot; the last is never heard."""


def test_a_dropout_names_its_sensor():
    model = level_model({f"s{k}": 1.0 for k in range(COUNT)}, 1e-6, linear=True)
    sensors = (replace(sensor, by_chance=k in BY_CHANCE) for k, sensor in enumerate(model.sensors))
    model = replace(model, sensors=tuple(sensors))
    log, rng = Log.of(model), np.random.default_rng(3)
    for k in range(COUNT):
        t = np.arange((GONE | BY_CHANCE).get(k, 99) + 1.0)
        log.add(f"s{k}", t + 0.001 * k, rng.normal(size=t.size))
    fold = folded("kf", model, log, expected=np.ones(COUNT))
    found = [(item.subject, item.cause, round(item.start)) for item in episodes(fold)]
    assert found == [(f"s{k}", "silent", last) for k, last in GONE.items()]
    assert fold.log.t[np.flatnonzero(fold.track.flags & ~(1 << 3))[0]] > 60 * SECOND
