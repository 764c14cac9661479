"""WebSockets of the page: state and chart points for each page, frames for each Rerun viewer.

A browser gets the next frame only once it has drawn the last one: a slow one loses frames and delays nobody.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from starlette.websockets import WebSocket, WebSocketDisconnect

from estimators.errors import ConfigError, nearest

from ..charts.chart_stream import ChartQuery, ChartStream, Seconds
from ..charts.series import Series
from ..engine.engine import Engine
from ..result import JsonObject
from .http import MAX_BODY_BYTES, one_line, parse
from .request_threads import in_rerun_thread, in_thread
from .twin_json import annotations_json, episodes_json, moment_json

if TYPE_CHECKING:
    from ..engine.notices import Annotation
    from ..explore.feed import RerunFeed
    from ..scene.renderer import Choices

FRAME_PERIOD_S = 0.1
STATUS_PERIOD_S = 0.25
RERUN_PERIOD_S = 0.2
RERUN_STATUS_PERIOD_S = 0.5
"""Shortest times between two messages of a kind."""

MAX_STREAMS = 24
"""Chart streams of one page."""

MANY_ENTRIES = 32
"""Entries of a field of the status from which on only the changed ones are sent."""

EQUAL_NS = 1_000
"""Rounding of the times of a page, whose numbers have 53 bits: of a calendar 256 ns. As EQUAL_S of charts.js."""

MAX_PARTICLES = 400
"""Particles in the chart of one state over another; a larger cloud is thinned."""


async def serve(browser: WebSocket, *works: Awaitable[None]) -> list[Exception]:
    """Run works concurrently until the first ends, then end the others and close the connection.

    Their errors are returned, except disconnections.
    """
    tasks = [asyncio.ensure_future(work) for work in works]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        # Awaited, so that no thread works for this browser any more afterwards.
        for task in tasks:
            task.cancel()
        outcomes = await asyncio.gather(*tasks, return_exceptions=True)
        with contextlib.suppress(RuntimeError):
            await browser.close()
    return [item for item in outcomes if isinstance(item, Exception) and not isinstance(item, WebSocketDisconnect)]


@dataclass(frozen=True)
class PageMessage:
    """Message of a page: it has drawn the last frames; the pair of states to show; chart streams, null to close one.

    `at` is the time that it shows, seconds since the first event, null for the newest row.
    """

    drawn: bool = False
    at: Seconds | None = None
    pair: tuple[str, str] | None = None
    streams: dict[str, ChartQuery | None] = field(default_factory=dict)


class PageStream:
    """Serves one page: JSON in text messages, frames of its chart streams in binary ones."""

    def __init__(
        self, browser: WebSocket, engine: Engine, series: Series, status: Callable[[], JsonObject], boot: str,
        choices: Choices | None = None,
    ) -> None:  # fmt: skip
        self._browser, self._engine, self._series, self._status = browser, engine, series, status
        self._streams: dict[str, ChartStream] = {}
        self._drawn, self._asked, self._pointed = asyncio.Event(), asyncio.Event(), asyncio.Event()
        self._drawn.set()
        self._sent: JsonObject = {}
        self._boot = boot
        self._episodes: list[JsonObject] | None = None
        self._notes: tuple[Annotation, ...] | None = None
        self._notice = 0
        self._pair: tuple[int, ...] | None = None
        self._estimated: tuple[int, int] | None = None
        self._choices = choices
        self._at: int | None = None
        """Time that the page shows, ns; None is the newest row."""
        self._moment: tuple[object, JsonObject] | None = None
        """Trust at that time, after what it was computed from."""

    async def run(self) -> None:
        """Serve until either side ends it."""
        await self._browser.accept()
        await self._browser.send_text(json.dumps({"boot": self._boot}))
        loop, watchers = asyncio.get_running_loop(), self._engine.revisions.watchers

        def refolded() -> None:
            with contextlib.suppress(RuntimeError):  # the server has ended
                loop.call_soon_threadsafe(self._asked.set)

        watchers.add(refolded)
        try:
            # The status does not wait for chart points, nor these for the fold.
            for error in await serve(self._browser, self._listen(), self._tell(), self._draw()):
                text = f"page error: {type(error).__name__}: {error}"
                self._engine.notices.report("page error", text, "error")
        finally:
            watchers.discard(refolded)
            if self._choices is not None:
                self._choices.leave(self)
            await in_thread(self._exchange, list(self._streams.values()), [])

    async def _listen(self) -> None:
        while True:
            try:
                text = await self._browser.receive_text()
            except (WebSocketDisconnect, KeyError, RuntimeError):  # the last where a message to it could not be sent
                return
            if len(text) > MAX_BODY_BYTES:
                return
            try:
                await self._take(json.loads(text))
            except (ConfigError, ValueError, RecursionError) as error:
                await self._browser.send_text(json.dumps({"error": one_line(str(error))}))

    async def _take(self, message: JsonObject) -> None:
        wanted = parse(PageMessage, message, "page")
        if wanted.drawn:
            self._drawn.set()
        if "pair" in message:
            known = list(self._engine.model.state_names)
            for name in wanted.pair or ():
                if name not in known:
                    raise ConfigError(f"pair: state {name!r} does not exist; {nearest(name, known)}")
            self._pair = None if wanted.pair is None else tuple(known.index(name) for name in wanted.pair)
            self._estimated = None
        if "at" in message and (origin := self._series.origin()) is not None:
            self._at = None if wanted.at is None else origin + round(wanted.at * 1e9) + EQUAL_NS
            if self._choices is not None:
                self._choices.show(self, self._at)
            self._pointed.set()
        if not wanted.streams:
            return
        # All are checked before any is changed.
        opened = {
            name: ChartStream(name, query, self._series.columns)
            for name, query in wanted.streams.items()
            if query is not None
        }
        if len({*self._streams, *wanted.streams}) > MAX_STREAMS:
            raise ConfigError(f"page: there are more than {MAX_STREAMS} chart streams; close some")
        closed = [stream for name, stream in self._streams.items() if name in wanted.streams]
        self._streams = {name: self._streams[name] for name in self._streams.keys() - wanted.streams} | opened
        # In a thread, as the levels of detail of a long history may have to be made.
        await in_thread(self._exchange, closed, list(opened.values()))
        self._asked.set()

    def _exchange(self, closed: list[ChartStream], opened: list[ChartStream]) -> None:
        """Open streams, then close others: levels that both need are kept."""
        for stream in opened:
            self._series.open(stream)
        for stream in closed:
            self._series.close(stream)

    async def _tell(self) -> None:
        """Send changes of status, episodes, notes of users and notices."""
        while True:
            begun = time.monotonic()
            self._pointed.clear()
            status, episodes, origin = await in_thread(
                lambda: (self._status(), episodes_json(self._engine), self._series.origin())
            )
            status["origin"] = None if origin is None else str(origin)
            status["moment"] = await in_thread(self._trust_then, self._at, episodes)
            message = changes(self._sent, status)
            self._sent = status
            if episodes != self._episodes:
                message["episodes"] = self._episodes = episodes
            if self._engine.annotations.notes is not self._notes:
                self._notes = self._engine.annotations.notes
                message["annotations"] = annotations_json(self._engine)
            notices = self._engine.notices.since(self._notice)
            if notices:
                self._notice = notices[-1].number + 1
                message["notices"] = [
                    {"number": item.number, "t": item.t, "level": item.level, "text": item.text, "run": item.revision}
                    for item in notices
                ]
            if message:
                await self._send(message)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(max(0.001, STATUS_PERIOD_S - (time.monotonic() - begun))):
                    await self._pointed.wait()

    def _trust_then(self, at: int | None, episodes: list[JsonObject]) -> JsonObject | None:
        """Return health, sensors, NIS and cause at the time that the page shows; None for the newest row."""
        if at is None:
            return None
        known = at, self._engine.index_at(at + 1), self._engine.revisions.runs[-1].number, len(episodes)
        if self._moment is None or self._moment[0] != known:
            self._moment = known, moment_json(self._engine, at)
        return self._moment[1]

    async def _draw(self) -> None:
        """Send chart points, once the page has drawn the last ones."""
        while True:
            begun = time.monotonic()
            if self._drawn.is_set():
                self._asked.clear()
                streams = list(self._streams.values())
                frames = await in_thread(self._series.frames, streams) if streams else []
                if frames:
                    self._drawn.clear()
                    for frame in frames:
                        await self._browser.send_bytes(frame)
                    # The page answers `drawn` once it has drawn all of them.
                    await self._browser.send_text('{"frames":true}')
            await self._send_estimate()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(max(0.001, FRAME_PERIOD_S - (time.monotonic() - begun))):
                    # A new query and a new revision are answered at once, if the page has drawn the last frames.
                    await self._drawn.wait()
                    await self._asked.wait()

    async def _send_estimate(self) -> None:
        """Send the joint estimate of the two states that the page shows, if it has changed."""
        if self._pair is None or self._sent.get("t") is None:
            return
        at = self._at
        now = (self._sent["revision"], self._sent["t"] if at is None else at)
        if now != self._estimated:
            self._estimated = now
            await self._send({"belief": await in_thread(belief_json, self._engine, list(self._pair), at)})

    async def _send(self, message: JsonObject) -> None:
        await self._browser.send_text(json.dumps(message, allow_nan=False, separators=(",", ":")))


def changes(before: JsonObject, now: JsonObject) -> JsonObject:
    """Return the message with the changed fields of a status; of a field with many entries only the changed ones.

    `status` has fields, `entries` entries by field. A field that has lost an entry is sent whole.
    """
    news = {key: value for key, value in now.items() if key not in before or before[key] != value}
    entries = {}
    for key, value in list(news.items()):
        old = before.get(key)
        if (
            isinstance(value, dict)
            and isinstance(old, dict)
            and len(value) >= MANY_ENTRIES
            and old.keys() <= value.keys()
        ):
            entries[key] = {name: item for name, item in value.items() if name not in old or old[name] != item}
            del news[key]
    return ({"status": news} if news or entries else {}) | ({"entries": entries} if entries else {})


def belief_json(engine: Engine, pair: list[int], at: int | None = None) -> JsonObject | None:
    """Return mean (2), covariance [a, b, c] of [[a, b], [b, c]] and particles (k, 2); None while not finite.

    `at` is a time, ns; None is the present.
    """
    belief = engine.belief(at)
    mean, cov = belief.mean[pair], belief.cov[np.ix_(pair, pair)]
    if not (np.isfinite(mean).all() and np.isfinite(cov).all()):
        return None
    points = np.asarray(belief.points)[:, pair] if len(belief.points) else np.zeros((0, 2))
    points = points[:: max(1, -(-len(points) // MAX_PARTICLES))]
    return {
        "mean": mean.tolist(),
        "cov": [float(cov[0, 0]), float(cov[0, 1]), float(cov[1, 1])],
        "points": points[np.isfinite(points).all(axis=1)].tolist(),
    }


async def feed_rerun(browser: WebSocket, feed: RerunFeed, status: Callable[[], JsonObject]) -> None:
    """Feed one Rerun viewer, and send its window the status."""
    drawn = asyncio.Event()
    drawn.set()

    async def listen() -> None:
        # A short text means that the last frame is drawn; the page sends nothing longer.
        while (word := (await browser.receive()).get("text")) is not None and len(word) <= MAX_BODY_BYTES:
            drawn.set()

    async def draw() -> None:
        sent = -RERUN_STATUS_PERIOD_S
        while True:
            begun = time.monotonic()
            if begun - sent >= RERUN_STATUS_PERIOD_S:
                sent = begun
                await browser.send_text(json.dumps(await in_thread(status)))
            if drawn.is_set():
                for message in await in_rerun_thread(feed.next):  # a long history takes a while
                    if isinstance(message, str):
                        await browser.send_text(message)
                    else:
                        drawn.clear()
                        await browser.send_bytes(message)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(drawn.wait(), RERUN_STATUS_PERIOD_S)
            await asyncio.sleep(max(0.0, RERUN_PERIOD_S - (time.monotonic() - begun)))

    try:
        await serve(browser, listen(), draw())
    finally:
        await in_rerun_thread(feed.close)
