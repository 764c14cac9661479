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

from ..live.interface import Running
from ..present.series.lane import Lane, wanted_from_json
from ..present.series.series import Series
from .api import episodes_json, one_line
from .belief_json import belief_json, pair_from_json

PERIOD = 0.1
"""Seconds between two frames, at least."""

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

    async def run(self) -> None:
        """Serve until either side ends it."""
        await self._browser.accept()
        await self._browser.send_text(json.dumps({"boot": self._boot}))
        # What the twin says of itself does not wait for its rows, nor these for the fold.
        tasks = [asyncio.create_task(work) for work in (self._listen(), self._tell(), self._draw())]
        loop, watchers = asyncio.get_running_loop(), self._engine.revisions.watchers

        def folded_anew() -> None:
            with contextlib.suppress(RuntimeError):  # the server has ended
                loop.call_soon_threadsafe(self._asked.set)

        watchers.add(folded_anew)
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            watchers.discard(folded_anew)
            for task in tasks:
                task.cancel()
            for outcome in await asyncio.gather(*tasks, return_exceptions=True):
                if isinstance(outcome, Exception) and not isinstance(outcome, WebSocketDisconnect):
                    self._engine.notices.report(
                        "page error", f"page error: {type(outcome).__name__}: {outcome}", "error"
                    )
            await asyncio.to_thread(self._exchange, list(self._lanes.values()), [])
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
                await self._take(json.loads(text))
            except (ConfigError, ValueError, RecursionError) as error:
                await self._browser.send_text(json.dumps({"error": one_line(str(error))}))

    async def _take(self, message: Any) -> None:
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
        if not wanted:
            return
        closed = [self._lanes[name] for name in wanted if name in self._lanes]
        opened = {name: Lane(name, want, self._series.columns) for name, want in wanted.items() if want is not None}
        kept = {name: lane for name, lane in self._lanes.items() if name not in wanted}
        self._lanes = {**kept, **opened}
        # In a thread, as the levels of a long history may just be made.
        await _finished(asyncio.to_thread(self._exchange, closed, list(opened.values())))
        self._asked.set()

    def _exchange(self, closed: list[Lane], opened: list[Lane]) -> None:
        """Look at other lanes; the new ones first, so that what both show is kept."""
        for lane in opened:
            self._series.open(lane)
        for lane in closed:
            self._series.close(lane)

    async def _tell(self) -> None:
        """Say what is new of the twin, again and again."""
        while True:
            begun = time.monotonic()
            await self._say()
            await asyncio.sleep(max(0.001, STATUS - (time.monotonic() - begun)))

    async def _draw(self) -> None:
        """Send what the page draws, when that has drawn what came before."""
        while True:
            begun = time.monotonic()
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
            await self._believe()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(max(0.001, PERIOD - (time.monotonic() - begun))):
                    # What a page asks for newly, and another revision, it shall see at once, if it has drawn the last.
                    await self._drawn.wait()
                    await self._asked.wait()

    async def _believe(self) -> None:
        """Send what is believed of the two states that the page shows, if that is news."""
        if self._pair is None or self._told.get("t") is None:
            return
        now = (self._told["revision"], self._told["t"])
        if now != self._believed:
            self._believed = now
            belief = await _finished(asyncio.to_thread(belief_json, self._engine, *self._pair))
            await self._send({"belief": belief})

    async def _say(self) -> None:
        status, episodes, origin = await _finished(asyncio.to_thread(self._look))
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
                {"number": item.number, "t": item.t, "level": item.level, "text": item.text, "run": item.revision}
                for item in notices
            ]
        if message:
            await self._send(message)

    def _look(self) -> tuple[dict[str, Any], list[dict[str, Any]], int | None]:
        return self._status(), episodes_json(self._engine), self._series.origin()

    async def _send(self, message: dict[str, Any]) -> None:
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
