"""Viser: the scene of the page, in a frame or in a window of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any
from urllib.parse import parse_qs

from estimators.diagnostics.references import shown_track

from ..charts.colors import THEMES
from ..engine.copies import MAX_PULL_ROWS, Pull
from ..engine.history_copy import follow
from ..engine.jobs import LoopThread
from ..engine.running_fold import Running
from .guarded_server import addresses, guarded_server, unprinted, when_connected
from .renderer import FIELD_SCENES, SceneRenderer
from .scene import History

FRAME_PERIOD_S = 0.1  # Seconds between two cheap frames
MAX_CPU_SHARE = 0.08  # Share of a core that drawing may take: expensive frames are drawn less often
MAX_FRAME_PERIOD_S = 2.0  # Largest time between two frames, seconds

EDIT_REST_S = 0.4
"""Seconds without an edit before the page's scene follows: the browser draws it on one thread with the charts."""

MAX_EDIT_WAIT_S = 1.0  # Seconds between two frames of that scene while a slider is dragged


class ViserView:
    """Pulls rows from the engine at its own rate, with a cursor of its own, so that the engine never waits.

    Without a browser it pulls, computes and sends nothing. The address of a browser's WebSocket has its theme:
    `?theme=dark`.

    Browsers reach `port` through the page's server only, which has `secret`.
    """

    def __init__(self, engine: Running, *, secret: str) -> None:
        self.engine = engine
        self.server = guarded_server(secret, engine.twin.title)
        self.port: int = self.server.get_port()
        self.renderer = SceneRenderer(self.server, engine)
        model, large = engine.model, engine.model.grid is not None
        limit = 4096 if large else 32_768
        self.history = History(len(model.shown), model.width, limit)
        self.history.span = int(engine.twin.config.view.window * 1e9)
        self._rows = min(MAX_PULL_ROWS, limit)
        self._cursor: Any = None
        self._past: tuple[int, int] | None = None
        """Last event of the past that the history has, and its revision; None while it follows the newest row."""
        self._tuning, self._turned, self._drawn = engine.tuning, -EDIT_REST_S, -MAX_EDIT_WAIT_S
        self._come = threading.Event()
        """Set when a browser connects, or to stop."""
        when_connected(self.server, self._come.set)
        self._thread = LoopThread(self._run, "viser view")

    def start(self) -> None:
        """Start drawing."""
        self._thread.start()

    def stop(self) -> None:
        """Stop drawing and the server."""
        self._thread.stop(30.0, self._come.set)
        self._rest()
        with unprinted():
            self.server.stop()

    def frame(self) -> None:
        """Update the scene to the engine's present state."""
        with self.server.atomic():
            at = self.renderer.choices.at
            if self.renderer.prepare() or (self._cursor is None) != (at is not None):
                self._rest()
            if at is None and self._cursor is None:
                self._cursor = self.engine.cursor(span=self.history.span)
            changed = (self._pull() if at is None else self._look_back(at)) or self.renderer.due
            if changed:
                self.renderer.draw(self.history, at)

    def _rest(self) -> None:
        """Forget all rows, and the cursor."""
        if self._cursor is not None:
            self.engine.release(self._cursor)
            self._cursor = None
        self._past = None
        self.history.clear()

    def _look_back(self, at: int) -> bool:
        """Take the rows of the window before a time, ns; return whether they are others than before."""
        engine, span = self.engine, self.history.span or 0
        wanted = engine.index_at(at + 1), engine.revisions.runs[-1].number
        if wanted == self._past:
            return False
        self._past = wanted
        self.history.clear()
        for start in range(engine.index_at(at - span), wanted[0], self._rows):
            self._take(engine.rows(start, min(start + self._rows, wanted[0])))
        return True

    def _pull(self) -> bool:
        """Take new rows; return whether there were any."""
        changed = False
        for pull in follow(self.engine, self._cursor, self._rows):
            changed |= bool(len(pull.events)) or pull.fresh
            self._take(pull)
        return changed

    def _take(self, pull: Pull) -> None:
        if isinstance(self.renderer.scene, FIELD_SCENES):
            self.renderer.scene.update(pull)
        self.history.update(replace(pull, track=shown_track(self.engine.model, pull.track)))
        self.history.trim()

    def _waits(self, now: float) -> bool:
        """Return whether the scene waits for the charts beside it, until the edited slider rests."""
        tuning = self.engine.tuning
        if tuning is not self._tuning:
            self._tuning, self._turned = tuning, now
        return now - self._turned < EDIT_REST_S and now - self._drawn < MAX_EDIT_WAIT_S

    def _look(self, there: Sequence[str]) -> None:
        """Draw for the connected browsers, whose addresses have these queries."""
        # Two browsers may differ; the scene has the colours of the last one's theme.
        self.renderer.palette = THEMES.get(parse_qs(there[-1]).get("theme", ["light"])[0], THEMES["light"])
        self.frame()

    def _run(self) -> None:
        due = time.monotonic()
        while True:
            self._come.clear()
            there = addresses(self.server)
            if self._thread.stopping.is_set():
                return
            if not there:
                self._rest()
                self._come.wait()
                continue
            self._come.wait(FRAME_PERIOD_S / 2)
            now = time.monotonic()
            if now >= due and not self._waits(now):
                self._drawn, begun = now, time.thread_time()
                try:
                    self._look(there)
                except Exception as error:  # noqa: BLE001  a frame that fails must not end the others
                    self.engine.notices.report("view error", f"view error: {type(error).__name__}: {error}", "error")
                # CPU time of this thread, not the time it waited.
                due = now + min(MAX_FRAME_PERIOD_S, max(FRAME_PERIOD_S, (time.thread_time() - begun) / MAX_CPU_SHARE))
