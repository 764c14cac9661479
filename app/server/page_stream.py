"""What one page is told: the state of the twin as it changes, and the points of the charts that it shows."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Callable
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from estimators.errors import ConfigError

from ..engine.interface import Running
from ..series.lane import Lane, wanted_from_json
from ..series.series import Series
from .api import episodes_json, one_line
from .belief_json import belief_json, pair_from_json

PERIOD = 0.1
"""Seconds between two frames, at least."""

WAITING = 0.03
"""The same while a refold is waited for: somebody has just turned something."""

HURRY = 0.5
"""Seconds for which it is so after a command, before which the engine has taken it."""

STATUS = 0.25
"""Seconds between two words on the state of the twin."""

MOST_LANES = 24
LONGEST = 65_536
"""Bytes of what a page may ask at once."""


class PageStream:
    """Serves one WebSocket: JSON in texts, frames of lanes in bytes; the next only when the last was drawn."""

    def __init__(
        self, browser: WebSocket, engine: Running, series: Series, status: Callable[[], dict[str, Any]], boot: str
    ) -> None:
        self._browser, self._engine, self._series, self._status = browser, engine, series, status
        self._lanes: dict[str, Lane] = {}
        self._drawn = asyncio.Event()
        self._drawn.set()
        self._asked = asyncio.Event()
        self._told: dict[str, Any] = {}
        self._boot = boot
        self._episodes: list[dict[str, Any]] | None = None
        self._notice = 0
        self._pair: tuple[int, int] | None = None
        self._believed: tuple[int, int] | None = None
        self._hurried = -HURRY

    def hurry(self) -> None:
        """A command has come: what follows from it shall not wait for the next frame."""
        self._hurried = time.monotonic()
        self._asked.set()

    async def run(self) -> None:
        """Serve until either side ends it."""
        await self._browser.accept()
        await self._browser.send_text(json.dumps({"boot": self._boot}))
        tasks = [asyncio.create_task(self._listen()), asyncio.create_task(self._tell())]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            for outcome in await asyncio.gather(*tasks, return_exceptions=True):
                if isinstance(outcome, Exception) and not isinstance(outcome, WebSocketDisconnect):
                    self._engine.notices.report(
                        "page error", f"page error: {type(outcome).__name__}: {outcome}", "error"
                    )
            for lane in self._lanes.values():
                self._series.close(lane)
            with contextlib.suppress(RuntimeError):
                await self._browser.close()

    async def _listen(self) -> None:
        while True:
            try:
                text = await self._browser.receive_text()
            except (WebSocketDisconnect, KeyError):
                return
            if len(text) > LONGEST:
                return
            try:
                self._take(json.loads(text))
            except (ConfigError, ValueError, RecursionError) as error:
                await self._browser.send_text(json.dumps({"error": one_line(str(error))}))

    def _take(self, message: Any) -> None:
        if not isinstance(message, dict):
            raise ConfigError(f"page: {message!r} is no object")
        if message.get("drawn"):
            self._drawn.set()
        if "pair" in message:
            self._pair, self._believed = pair_from_json(message["pair"], self._engine), None
        lanes = message.get("lanes", {})
        if not isinstance(lanes, dict):
            raise ConfigError(f"page: lanes is {lanes!r}; it must be an object")
        # All are looked at before any is changed.
        wanted = {
            name: None if body is None else wanted_from_json(body, self._series.columns) for name, body in lanes.items()
        }
        if len({*self._lanes, *wanted}) > MOST_LANES:
            raise ConfigError(f"page: there are more than {MOST_LANES} lanes; close some")
        for name, want in wanted.items():
            if name in self._lanes:
                self._series.close(self._lanes.pop(name))
            if want is not None:
                self._lanes[name] = Lane(name, want, self._series.columns)
                self._series.open(self._lanes[name])
        if wanted:
            self._asked.set()

    async def _tell(self) -> None:
        told = -STATUS
        while True:
            begun = time.monotonic()
            if begun - told >= STATUS:
                told = begun
                await self._say()
            if self._drawn.is_set():
                self._asked.clear()
                lanes = list(self._lanes.values())
                frames = await _finished(asyncio.to_thread(self._series.frames, lanes)) if lanes else []
                if frames:
                    self._drawn.clear()
                    for frame in frames:
                        await self._browser.send_bytes(frame)
                    # The page says `drawn` once it has drawn all of them.
                    await self._browser.send_text('{"frames":true}')
            awaited = time.monotonic() - self._hurried < HURRY or self._engine.status().refolding
            rest = (WAITING if awaited else PERIOD) - (time.monotonic() - begun)
            with contextlib.suppress(TimeoutError):
                # What a page asks for newly, it shall see at once.
                await asyncio.wait_for(self._asked.wait(), max(0.001, rest))

    async def _say(self) -> None:
        status, episodes = await _finished(asyncio.to_thread(lambda: (self._status(), episodes_json(self._engine))))
        origin = self._series.origin()
        status["origin"] = None if origin is None else str(origin)
        news = {key: value for key, value in status.items() if key not in self._told or self._told[key] != value}
        self._told = status
        message: dict[str, Any] = {"status": news} if news else {}
        if episodes != self._episodes:
            message["episodes"] = self._episodes = episodes
        notices = self._engine.notices.since(self._notice)
        if notices:
            self._notice = notices[-1].number + 1
            message["notices"] = [
                {"number": item.number, "t": item.t, "level": item.level, "text": item.text} for item in notices
            ]
        if self._pair is not None and status["t"] is not None:
            now = (status["revision"], status["t"])
            if now != self._believed:
                self._believed = now
                message["belief"] = await _finished(asyncio.to_thread(belief_json, self._engine, *self._pair))
        if message:
            await self._browser.send_text(json.dumps(message, allow_nan=False, separators=(",", ":")))


async def _finished(work: Any) -> Any:
    """The result of work in a thread, which is waited for even when nobody wants it any more."""
    task = asyncio.ensure_future(work)
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        with contextlib.suppress(Exception):
            await task
        raise
