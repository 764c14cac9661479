"""Dropouts of more sensors than have a bit of their own in the track: each is named, and no other."""

import numpy as np

from estimators.diagnostics.detectors import SENSOR_FLAGS
from estimators.diagnostics.episodes import episodes
from estimators.log import Log
from tests.models import level_model
from tests.support import folded

COUNT = SENSOR_FLAGS + 12
GONE = {3: 40, SENSOR_FLAGS + 5: 60}
"""Sensors that drop out, with the second of their last measurement."""


def test_a_dropout_names_its_sensor():
    model = level_model({f"s{k}": 1.0 for k in range(COUNT)}, 1e-6, linear=True)
    log, rng = Log.of(model), np.random.default_rng(3)
    for k in range(COUNT):
        t = np.arange(GONE.get(k, 99) + 1.0)
        log.add(f"s{k}", t + 0.001 * k, rng.normal(size=t.size))
    found = [(item.subject, item.cause, round(item.start)) for item in episodes(folded("kf", model, log))]
    assert found == [(f"s{k}", "silent", last) for k, last in GONE.items()]
