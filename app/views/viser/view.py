"""Viser: the stage of the page, and the same scene with a small panel in a window of its own, for any browsers."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Any
from urllib.parse import parse_qs

from ...live.interface import Running
from ...present.drawing.colors import THEMES
from ...present.series.series import Series
from .guarded_server import addresses, guarded_server, unprinted
from .panel import Panel
from .scene import History
from .stage import PICTURED, Stage

FRAME = 0.1
"""Seconds between two frames, when they are cheap."""

SHARE = 0.08
"""Part of a core that drawing may take: dearer frames come less often."""

SLOWEST = 2.0
"""Seconds between two frames at most."""

RESTED = 0.4
"""Seconds for which a knob must rest before the page's scene follows it: it is drawn on one thread with the charts."""

LATEST = 1.0
"""Seconds between two frames of that scene while a knob is dragged."""

ROWS = 16_384
"""Rows pulled at once, so that a long history does not hold the engine's lock for long."""


class ViserView:
    """Pulls rows from the engine at its own rate, with a cursor of its own, and never keeps the engine waiting.

    While no browser is there it pulls, computes and sends nothing. A browser says by the address of its WebSocket what
    it shows: `?part=scene` for the scene alone, so that the panel is not kept up for it, and `theme=dark`.

    `port` is known once the view is built; browsers reach it through the page's server only, which knows `secret`.
    """

    def __init__(self, engine: Running, *, secret: str) -> None:
        self.engine = engine
        self.server = guarded_server(secret, engine.twin.title)
        self.port: int = self.server.get_port()
        self.stage = Stage(self.server, engine)
        self.panel = Panel(self.server, engine, self.stage)
        model, large = engine.model, engine.model.grid is not None
        limit = 4096 if large else 32_768
        self.history = History(len(model.shown), model.width, limit)
        self.history.span = int(engine.twin.config.view.window * 1e9)
        self._series = Series(engine)
        self._rows = min(ROWS, limit)
        self._cursor: Any = None
        self._tuning, self._turned, self._drawn = engine.tuning, -RESTED, -LATEST
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viser view", daemon=True)

    def start(self) -> None:
        """Begin to draw."""
        self._thread.start()

    def stop(self) -> None:
        """End drawing, and the server with it."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self._rest()
        with unprinted():
            self.server.stop()

    def frame(self, *, panel: bool = True) -> None:
        """Bring the scene, and if it is seen the panel, up to what the engine has now."""
        with self.server.atomic():
            if self.stage.prepare() or self._cursor is None:
                self._begin()
            changed = self._pull() or self.stage.due
            if changed:
                self.stage.draw(self.history)
            if panel:
                self.panel.sync(self._series.origin())

    def _begin(self) -> None:
        """Pull what the window shows, from its start."""
        self._rest()
        self._cursor = self.engine.cursor(span=self.history.span)

    def _rest(self) -> None:
        if self._cursor is not None:
            self.engine.release(self._cursor)
            self._cursor = None
            self.history.clear()
            self.panel.nis.close()

    def _pull(self) -> bool:
        """Take what is new; whether there was anything."""
        changed = False
        while True:
            pull = self.engine.pull(self._cursor, self._rows)
            changed |= bool(len(pull.events)) or pull.fresh
            if isinstance(self.stage.scene, PICTURED):
                self.stage.scene.take(pull)
            self.history.take(pull)
            self.history.trim()
            if len(pull.events) < self._rows:
                return changed

    def _waits(self, now: float, there: Sequence[str]) -> bool:
        """Whether charts come first: beside them the scene waits until the knob that is turned rests."""
        tuning = self.engine.tuning
        if tuning is not self._tuning:
            self._tuning, self._turned = tuning, now
        return _scene_alone(there) and now - self._turned < RESTED and now - self._drawn < LATEST

    def _look(self, there: Sequence[str]) -> None:
        """Draw for the browsers that are there, whose addresses have these queries."""
        # Two browsers may differ; one scene has the colours that the last of them can see best.
        self.stage.palette = THEMES.get(parse_qs(there[-1]).get("theme", ["light"])[0], THEMES["light"])
        self.frame(panel=not _scene_alone(there))

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stop.wait(FRAME / 2):
            there = addresses(self.server)
            if not there:
                self._rest()
                continue
            now = time.monotonic()
            if now >= due and not self._waits(now, there):
                self._drawn, begun = now, time.thread_time()
                try:
                    self._look(there)
                except Exception as error:  # noqa: BLE001  a picture that cannot be drawn must not end the others
                    self.engine.notices.report("view error", f"view error: {type(error).__name__}: {error}", "error")
                # This thread's own work counts, not the time it waited for its turn.
                due = now + min(SLOWEST, max(FRAME, (time.thread_time() - begun) / SHARE))


def _scene_alone(there: Sequence[str]) -> bool:
    """Whether no browser, by the query of its address, shows the panel as well."""
    return all(parse_qs(query).get("part") == ["scene"] for query in there)
