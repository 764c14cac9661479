"""`nisus push URL`: send the lines of standard input to a running twin whose source is of type push."""

from __future__ import annotations

import csv
import json
import os
import queue
import sys
import threading
import time
import uuid
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from decimal import Decimal, InvalidOperation
from urllib.error import HTTPError, URLError
from urllib.parse import parse_qs, urlsplit
from urllib.request import ProxyHandler, Request, build_opener

from app.result import JsonObject, to_json
from app.terminal import complain
from estimators.errors import ConfigError, nearest, quoted, shown_name

from .arguments import PushCommand as Arguments

MAX_BATCH_LINES, BATCH_S = 2000, 0.02  # Lines sent at once, and the wait for further ones after the first
MAX_WAITING_LINES = 10_000  # Lines read ahead; a pipe waits then
TIMEOUT_S, MAX_RETRY_S = 30.0, 5.0
MAX_SHOWN = 20  # refused lines that are shown; the others are counted
NS = {"s": 10**9, "ms": 10**6, "us": 1000, "ns": 1}


def push(arguments: Arguments) -> int:
    """Run the command: 0 if no line was refused, else 1."""
    twin = TwinClient(arguments.url or os.environ.get("NISUS_URL", ""))
    names = {item["name"] for item in twin.request()["values"]}
    rows = RowReader(sys.stdin, names, arguments.time, NS[arguments.unit], arguments.source or uuid.uuid4().hex)
    counts: Counter[str] = Counter(accepted=0, duplicate=0, refused=0)
    shown = 0
    try:
        for lines, messages in rows.batches():
            for item in twin.request(messages)["items"]:
                counts[item["status"]] += 1
                if item.get("became") == "stale":
                    counts["stale"] += 1
                if "reason" in item:
                    shown += 1
                    if shown <= MAX_SHOWN:
                        complain(f"line {lines[item['index']]}: {item['reason']}")
    except KeyboardInterrupt:
        pass
    print(to_json(dict(counts)) if arguments.json else ", ".join(f"{n:,} {word}" for word, n in counts.items()))
    return int(counts["refused"] > 0)


class RowReader:
    """Lines of a stream as messages: NDJSON, or CSV whose first line has the names of its columns."""

    def __init__(self, stream: Iterable[str], names: set[str], time_column: str | None, ns: int, source: str) -> None:
        self._stream, self._names, self._ns, self._source = stream, names, ns, source
        self._time, self._timed = time_column or "time", time_column is not None
        self._columns: list[str] | None = None
        self._waiting: queue.Queue[tuple[int, str] | None] = queue.Queue(MAX_WAITING_LINES)
        threading.Thread(target=self._read, name="standard input", daemon=True).start()

    def _read(self) -> None:
        for line in enumerate(self._stream, 1):
            self._waiting.put(line)
        self._waiting.put(None)

    def batches(self) -> Iterator[tuple[list[int], list[object]]]:
        """Yield the lines that have come, as their numbers and messages."""
        ended = False
        while not ended:
            found = []
            for item in self._ready():
                if item is None:
                    ended = True
                    break
                if (message := self._message(*item)) is not None:
                    found.append((item[0], message))
            if found:
                yield [number for number, _ in found], [message for _, message in found]

    def _ready(self) -> Iterator[tuple[int, str] | None]:
        """Yield the next line, and those that come within a moment after it; None is the end."""
        yield self._waiting.get()
        end = time.monotonic() + BATCH_S
        with suppress(queue.Empty):
            for _ in range(MAX_BATCH_LINES - 1):
                yield self._waiting.get(timeout=max(0.0, end - time.monotonic()))

    def _message(self, number: int, line: str) -> object:
        """Return the message of a line; None if it is empty, or names the columns."""
        if number == 1:
            line = line.removeprefix("\ufeff")
        if not line.strip():
            return None
        if self._columns is None and line.lstrip().startswith("{"):
            try:
                message = json.loads(line)
            except (ValueError, RecursionError):
                return quoted(line.strip())
            # A number of its own makes a repeated request harmless.
            return {"source": self._source, "sequence": number, **message} if isinstance(message, dict) else message
        try:
            cells = next(csv.reader([line]))
        except csv.Error:  # a field that is too long
            return quoted(line.strip())
        if self._columns is None:
            self._columns = [cell.strip() for cell in cells]
            if not self._names & set(self._columns):
                known = ", ".join(sorted(self._names))
                raise ConfigError(f"line {number}: none of its columns is a value of the twin, which reads {known}")
            if self._timed and self._time not in self._columns:
                remedy = nearest(self._time, self._columns)
                raise ConfigError(f"--time {shown_name(self._time)}: line {number} has no such column; {remedy}")
            return None
        row = dict(zip(self._columns, cells, strict=False))
        values = {name: _number(row[name]) for name in self._names & row.keys() if row[name].strip()}
        message = {"source": self._source, "sequence": number, "values": values}
        return message | ({"time": _time(row[self._time], self._ns)} if row.get(self._time, "").strip() else {})


def _number(cell: str) -> float | str:
    try:
        return float(cell)
    except ValueError:
        return cell.strip()


def _time(cell: str, ns: int) -> int | str:
    """Return a time as the API takes it: a number in ns, exactly, or text."""
    try:
        return int(Decimal(cell.strip()) * ns)
    except (InvalidOperation, ValueError, OverflowError):
        return cell.strip()


class TwinClient:
    """The address of a running twin, with its token."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        token = parse_qs(parts.query).get("token", [""])[0]
        readable = token.isascii() and token.isprintable()
        if parts.scheme not in ("http", "https") or not parts.netloc or not (token and readable):
            remedy = "give the one that `nisus run` printed, here or as NISUS_URL"
            raise ConfigError(f"{quoted(url)}: is no address of a twin with its token; {remedy}")
        # The page of a twin among several is at /twins/NAME/.
        self._url = f"{parts.scheme}://{parts.netloc}{parts.path.rstrip('/')}/api/readings"
        self._headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
        self._opener = build_opener(ProxyHandler({}))

    def request(self, messages: list[object] | None = None) -> JsonObject:
        """Return the answer to messages, or to the question for names; wait while the twin is not there.

        Raises:
            ConfigError: If the twin refuses the request, or was not there from the start.
        """
        wait, body = 0.1, None if messages is None else json.dumps(messages).encode()
        while True:
            try:
                with self._opener.open(Request(self._url, body, self._headers), timeout=TIMEOUT_S) as found:
                    answer: JsonObject = json.load(found)
                    return answer
            except HTTPError as error:
                text = error.read().decode(errors="replace").strip()
                raise ConfigError(f"the twin refuses: {_reason(text)}") from None
            except (URLError, OSError) as error:
                if messages is None:
                    raise ConfigError(
                        f"{self._url}: no twin answers ({error}); start it, or check the address"
                    ) from None
                if wait == 0.1:
                    complain(f"{self._url}: no twin answers; its lines wait")
                time.sleep(wait)
                wait = min(MAX_RETRY_S, 2 * wait)


def _reason(text: str) -> str:
    try:
        return str(json.loads(text)["error"])
    except (ValueError, KeyError, TypeError):
        return text
