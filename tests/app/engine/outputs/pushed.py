"""A twin whose measurements are pushed, one a second from `BEGIN` on."""

import json

from app.twin.twin import load_twin
from tests.support import SECOND

BEGIN = 1_767_225_600 * SECOND


def pushed_twin(outputs, source="{type: push}", **more):
    """The twin of a motor's winding with these outputs; `more` overrides its YAML."""
    given = {"source": source, "outputs": json.dumps(outputs), "time.tick": "1000"}
    return load_twin("motor_winding", overrides=given | more)


def push(page, *items):
    """Push measurements (second, value) over the API."""
    for k, value in items:
        message = {"time": BEGIN + k * SECOND, "values": {"winding": value}}
        assert page.post("/api/readings", **message)[1]["accepted"] == 1
