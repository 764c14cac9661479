"""A twin whose measurements are pushed, one a second from `BEGIN` on."""

import json
from contextlib import contextmanager

from app.engine.outputs.publisher import Publisher
from app.twin.twin import load_twin
from sources.source import ignore
from tests.support import SECOND

BEGIN = 1_767_225_600 * SECOND


def pushed_twin(outputs, source="{type: push}", **more):
    """The twin of a motor's winding with these outputs; `more` overrides its YAML."""
    given = {"source": source, "outputs": json.dumps(outputs), "time.predict_every": "1000"}
    return load_twin("motor_winding", overrides=given | more)


@contextmanager
def publishing(serve, twin, **options):
    """The page of a twin of `pushed_twin` while its publisher runs."""
    page = serve(twin=twin, behind=lambda _: twin.open_source(ignore))
    publisher = page.engine.published = Publisher(page.engine, **options)
    publisher.start()
    try:
        yield page
    finally:
        publisher.stop()


def push(page, *items):
    """Push measurements (second, value) over the API."""
    for k, value in items:
        message = {"time": BEGIN + k * SECOND, "values": {"winding": value}}
        assert page.post("/api/readings", **message)[1]["accepted"] == 1
