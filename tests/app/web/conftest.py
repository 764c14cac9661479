"""Served engines that the tests of the API share."""

import threading
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from estimators.fit.objective import Objective
from tests.app.scripted import readings
from tests.app.served import ServedEngine
from tests.waiting import LIMIT_S, wait_for


@contextmanager
def serving(folder):
    """serve(n, std): an engine behind its page, with so many measurements of a constant temperature of 40 °C."""
    opened = []

    def serve(n=0, std=1.0, **options):
        opened.append(ServedEngine(**options))
        if n:
            values = 40.0 + std * np.random.default_rng(4).normal(size=n)
            opened[-1].source.put(readings(np.arange(1.0, n + 1.0) * 0.1, values))
            wait_for(lambda: opened[-1].rows() == n)
        return opened[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        # The viewer's files are tested elsewhere; to make them takes a while.
        patch.setattr("app.web.server.viewer_assets", lambda progress: folder)
        yield serve
        for page in opened:
            page.stop()


def reviewing(serve, folder):
    """An engine behind its page that reviews a recording."""
    recording = folder / "reviewed.rrd"
    recording.write_bytes(b"RRF2 and so on")
    (folder / "private.rrd").write_bytes(b"nobody's business")
    return serve(review=recording)


@pytest.fixture
def serve(tmp_path):
    with serving(tmp_path) as serve:
        yield serve


@pytest.fixture
def page(serve, tmp_path):
    return reviewing(serve, tmp_path)


@pytest.fixture
def halted(monkeypatch):
    """Fits halt at their first gain: `reached` is set then, and they go on once `released` is set."""
    reached, released = threading.Event(), threading.Event()
    terms = Objective.all_terms

    def waiting(self, points):
        if self.progress.gain > 0.0:
            reached.set()
            assert released.wait(LIMIT_S)
        return terms(self, points)

    monkeypatch.setattr(Objective, "all_terms", waiting)
    yield SimpleNamespace(reached=reached, released=released)
    released.set()
