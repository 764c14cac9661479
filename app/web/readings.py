"""Measurements by HTTP, for twins whose source is of type push; see `sources/messages.py`."""

from __future__ import annotations

import asyncio
import json
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Protocol

import numpy as np
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import BaseRoute, Route

from estimators.errors import ConfigError, shown_name
from sources.messages import ACCEPTED, CLOSED, DUPLICATE, NO_ROOM, REFUSED, Answer, Messages

from ..engine.outcomes import Outcomes
from ..engine.running_fold import StateWriter
from ..result import JsonObject
from ..twin.twin import Twin
from .http import Json, TooLarge, bounded_body, get, refusal
from .request_threads import in_thread

MAX_BYTES = 8 * 2**20
"""Longest body of measurements."""

MAX_MESSAGES = 100_000
"""Most messages of one body; a row of an Arrow batch may need no byte at all."""

RECORD_BATCH = 3
"""Type of an Arrow message with rows."""

STORE_TIMEOUT_S, OUTCOME_TIMEOUT_S, POLL_S = 2.0, 0.5, 0.005
"""Longest wait for the store, and for the outcomes, and the time between two looks at them."""


class Recipient(Protocol):
    """A running twin or fleet, whose source may take messages."""

    @property
    def source(self) -> object:
        """Its source."""

    @property
    def store(self) -> StateWriter | None:
        """Where it keeps its state."""

    @property
    def twin(self) -> Twin:
        """The twin."""

    @property
    def outcomes(self) -> Outcomes:
        """What became of its messages."""


def routes(engine: Recipient) -> list[BaseRoute]:
    """Return the routes of a running twin or fleet."""

    def names() -> JsonObject:
        """Return names and units of the values that the twin reads."""
        source = messages_of(engine)
        return {"values": [{"name": name, "unit": source.units.get(name)} for name in source.names]}

    async def send(request: Request) -> Response:
        """Take measurements; answer what became of each."""
        kind = request.headers.get("content-type", "").partition(";")[0].strip()
        try:
            source = messages_of(engine)
        except ConfigError as error:
            return refusal(error, 409)
        if kind not in READERS:
            return PlainTextResponse(f"Nisus: Content-Type must be one of {', '.join(READERS)}.\n", 415)
        try:
            body = await bounded_body(request, MAX_BYTES)
            messages = await in_thread(lambda: READERS[kind](body, source.fields))
            _check_count(len(messages))
            found = await send_to(engine, messages)
            if found["items"] and all(item.get("reason") == NO_ROOM.reason for item in found["items"]):
                return Json(found | {"error": NO_ROOM.reason}, 429)
            return Json(found)
        except TooLarge:
            bounds = f"{MAX_BYTES // 2**20} MB and {MAX_MESSAGES:,} messages"
            return PlainTextResponse(f"Nisus: a body may have {bounds}; send fewer messages at once.\n", 413)
        except ConfigError as error:
            return refusal(error)

    return [get("/api/readings", names, refused=409), Route("/api/readings", send, methods=["POST"])]


def messages_of(engine: Recipient) -> Messages:
    """Return the source of messages of a running twin or fleet.

    Raises:
        ConfigError: If its source is of another type.
    """
    source = getattr(engine.source, "inner", engine.source)
    if not isinstance(source, Messages):
        kind = engine.twin.config.source.type
        raise ConfigError(f"the source of {engine.twin.name} is of type {kind}; only one of type push takes messages")
    return source


async def send_to(engine: Recipient, messages: Sequence[object]) -> JsonObject:
    """Send messages; return what became of each, the counts, and whether the store has them."""
    source = messages_of(engine)
    answers = await in_thread(lambda: source.send(messages))
    mark = source.accepted
    became = await outcomes(engine, mark, answers)
    kept = await stored(engine, mark)
    if source.closed and not kept:  # meanwhile: they are not folded, or their state is lost
        answers, became = [CLOSED if item.status == ACCEPTED else item for item in answers], {}
    return summary(answers, became) | {"stored": kept}


def summary(answers: Sequence[Answer], became: Mapping[int, str] = MappingProxyType({})) -> JsonObject:
    """Return the answers and their counts, with what `became` of accepted ones by arrival, as far as it is known."""
    counts = {status: sum(item.status == status for item in answers) for status in (ACCEPTED, DUPLICATE, REFUSED)}
    items = [
        {"index": k, "status": item.status}
        | ({"became": became[item.arrival]} if item.status == ACCEPTED and item.arrival in became else {})
        | ({"reason": item.reason} if item.reason else {})
        for k, item in enumerate(answers)
    ]
    return counts | {"items": items}


async def outcomes(engine: Recipient, mark: int, answers: Sequence[Answer]) -> dict[int, str]:
    """Wait until messages up to a mark have been taken; return what became of each by its arrival, none if too long."""
    arrivals = np.array([item.arrival for item in answers if item.status == ACCEPTED], np.int64)
    end = time.monotonic() + OUTCOME_TIMEOUT_S
    while arrivals.size and time.monotonic() < end:
        found = engine.outcomes.of(mark, arrivals)
        if found is not None:
            return dict(zip(arrivals.tolist(), found, strict=True))
        await asyncio.sleep(POLL_S)
    return {}


async def stored(engine: Recipient, mark: int) -> bool:
    """Wait until the store has the messages up to a mark; return whether it does, at once without a store."""
    store, end = engine.store, time.monotonic() + STORE_TIMEOUT_S
    while store is not None and (found := store.has(mark)) is not None:
        if found or time.monotonic() > end:
            return found
        store.request_write()
        await asyncio.sleep(POLL_S)
    return False


def _of_json(body: bytes, fields: Sequence[str]) -> Sequence[object]:
    try:
        found = json.loads(body)
    except (ValueError, RecursionError):
        raise ConfigError("the body is no JSON; send one message, a list of them, or lines as NDJSON") from None
    return found if isinstance(found, list) else [found]


def _of_lines(body: bytes, fields: Sequence[str]) -> Sequence[object]:
    """Return the messages of NDJSON; a line that is no JSON is refused alone."""
    found: list[object] = []
    for line in body.splitlines():
        if line.strip():
            try:
                found.append(json.loads(line))
            except (ValueError, RecursionError):
                found.append(None)
    return found


def _check_count(messages: int) -> None:
    if messages > MAX_MESSAGES:
        raise TooLarge(f"a body may have {MAX_MESSAGES:,} messages; send fewer at once")


def _of_arrow(body: bytes, fields: Sequence[str]) -> Sequence[object]:
    """Return the messages of a stream of Arrow batches: the fields of a message, and a column for each value."""
    import pyarrow as pa

    types, rows = pa.types, 0
    known = [types.is_integer, types.is_floating, types.is_boolean, types.is_null, types.is_timestamp]
    known += [types.is_string, types.is_large_string]
    try:
        if any(_is_compressed(piece.metadata.to_pybytes()) for piece in pa.ipc.MessageReader.open_stream(body)):
            raise ConfigError("the batches are compressed; send them without compression")
        stream, batches = pa.ipc.open_stream(body), []
        for field in stream.schema:
            # Nested types, views and dictionaries may name the same bytes any number of times.
            if not any(is_it(field.type) for is_it in known):
                name, kind = shown_name(field.name), shown_name(str(field.type))
                raise ConfigError(f"column {name} is of type {kind}; it must have numbers, texts or times")
        for batch in stream:
            _check_count(rows := rows + batch.num_rows)
            # Otherwise a length that is wrong reads the memory behind the body.
            batch.validate(full=True)
            batches.append(batch)
        table = pa.Table.from_batches(batches, stream.schema)
        for k, field in enumerate(table.schema):
            if pa.types.is_timestamp(field.type):
                table = table.set_column(k, field.name, table.column(k).cast(pa.timestamp("ns")).cast(pa.int64()))
        rows = table.to_pylist()
    except (pa.ArrowException, ValueError, OSError, IndexError, struct.error) as error:
        raise ConfigError(f"the body is no stream of Arrow batches: {error}") from None
    return [_message(row, fields) for row in rows]


def _is_compressed(message: bytes) -> bool:
    """Return whether the metadata of an Arrow message (a flatbuffer) describe a batch with compressed buffers.

    Source: Apache Arrow, format/Message.fbs. Message has header_type and header as fields 1 and 2, RecordBatch has
    compression as field 3.
    """

    def place(table: int, field: int) -> int:
        entries = table - struct.unpack_from("<i", message, table)[0]
        (size,) = struct.unpack_from("<H", message, entries)
        at = struct.unpack_from("<H", message, entries + 4 + 2 * field)[0] if 6 + 2 * field <= size else 0
        return table + at if at else 0

    def table_at(at: int) -> int:
        return at + int(struct.unpack_from("<I", message, at)[0])

    root = table_at(0)
    kind, header = place(root, 1), place(root, 2)
    return bool(kind and header) and message[kind] == RECORD_BATCH and place(table_at(header), 3) != 0


def _message(row: Mapping[str, object], fields: Sequence[str]) -> JsonObject:
    """Return a message of a row; a null is no value, as rows of one batch may come from several sensors."""
    head = {name: row[name] for name in fields if name != "values" and row.get(name) is not None}
    return head | {"values": {name: value for name, value in row.items() if name not in fields and value is not None}}


READERS: dict[str, Callable[[bytes, Sequence[str]], Sequence[object]]] = {
    "application/json": _of_json,
    "application/x-ndjson": _of_lines,
    "application/vnd.apache.arrow.stream": _of_arrow,
}
"""By the type of a body; they take the body and the fields of a message."""
