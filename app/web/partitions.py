"""A fleet over several processes: each folds the assets of its partition; the table is that of all."""

from __future__ import annotations

import asyncio
import http.client
import io
import json
import os
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from starlette.applications import Starlette
from starlette.responses import Response
from starlette.routing import BaseRoute, Route

from estimators.errors import SourceError
from estimators.fleet.table import FleetTable
from sources.messages import ASSET, REFUSED, Answer
from sources.source import Partition, Report

from ..live.fleet import RunningFleet
from ..twin.fleet import FleetPlan
from ..twin.twin import Twin
from . import readings
from .door import Door
from .http import Json
from .request_threads import in_thread
from .supervisor import FAILED, RUNNING, Child, ServedTwin, Supervisor

TIMEOUT_S = 30.0
"""Longest wait for the answer of a process."""

TABLE_PATH, READINGS_PATH = "/api/table", "/api/readings"


def path_of(path: Path, partition: Partition) -> Path:
    """Return the store or archive of a partition: that of the fleet, with the number of each process but the first."""
    return path.with_name(f"{path.name}.{partition.number}") if partition.number else path


def threads_of(processes: int) -> int:
    """Return the number of threads that fold in each process."""
    return max(1, (os.cpu_count() or 1) // processes)


class PartitionServer:
    """Serves the table of a partition to the process of the fleet, and takes its messages."""

    def __init__(self, running: RunningFleet) -> None:
        self.running, self.door = running, Door(0)
        routes: list[BaseRoute] = [Route(f"{TABLE_PATH}/{{version}}", self._table), *readings.routes(running)]
        self.door.show(Starlette(routes=routes))

    def start(self) -> None:
        """Begin to read and fold."""
        self.door.start()
        self.running.start()

    def stop(self) -> None:
        """Stop."""
        self.running.stop()
        self.door.stop()

    def report(self) -> Mapping[str, Any]:
        """Return its state for the process of the fleet.

        Raises:
            SourceError: If the source or the store has failed.
        """
        if self.running.failure:
            raise SourceError(self.running.failure)
        return {"version": self.running.version, "ended": self.running.ended}

    async def _table(self, request: Any) -> Response:
        """Answer with the table, unless the version is the present one."""
        running = self.running
        ended, counts = running.ended, dict(running.counts)
        version, names, table = running.table()
        head: dict[str, Any] = {"version": version, "ended": ended, "counts": counts}
        if str(version) == request.path_params["version"]:
            return Json(head)
        body = io.BytesIO()
        columns = {name: getattr(table, name) for name in FleetTable._fields[1:]}
        text = json.dumps(head | {"names": names}).encode()
        np.savez(body, allow_pickle=False, head=np.frombuffer(text, np.uint8), **columns)
        return Response(body.getvalue(), media_type="application/octet-stream")


class _Part:
    """Last known table of a partition."""

    def __init__(self, twin: ServedTwin, partition: Partition) -> None:
        self.twin, self.partition = twin, partition
        self.version = (-1, -1)
        """Start of the process, and version of its table."""
        self.ended = False
        self.counts: Mapping[str, int] = {}
        self.names: list[str] = []
        self.columns: dict[str, np.ndarray] = {}

    def request(self, method: str, path: str, body: bytes | None = None) -> tuple[str, bytes]:
        """Return type and body of an answer of the process.

        Raises:
            OSError: If it does not run, or does not answer.
        """
        twin = self.twin
        if not twin.port:
            raise OSError(f"{twin.name} is {twin.state}")
        headers = {"authorization": f"Bearer {twin.token}", "content-type": "application/json"}
        connection = http.client.HTTPConnection("127.0.0.1", twin.port, timeout=TIMEOUT_S)
        try:
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            content = answer.read()
        except http.client.HTTPException as error:
            raise OSError(f"{twin.name} does not answer ({error})") from None
        finally:
            connection.close()
        if answer.status != 200:
            raise OSError(f"{twin.name} answers with {answer.status}")
        return answer.headers.get_content_type(), content


class PartitionedFleet:
    """Runs the processes of a fleet, and answers with the table of all assets as a `RunningFleet` does."""

    def __init__(self, plan: FleetPlan, report: Report, child: Child, *, preload: Sequence[str] = ()) -> None:
        """Prepare; nothing runs yet.

        Args:
            plan: The fleet.
            report: Called as report(key, text) for what cannot be used.
            child: Runs the partition whose number is its path.
            preload: Modules that the processes share.
        """
        self.plan, count = plan, plan.config.processes
        names = {f"{plan.name} {k + 1} of {count}": str(k) for k in range(count)}
        self._supervisor = Supervisor(names, child, preload=preload, at_once=count)
        twins = self._supervisor.twins.values()
        self._parts = [_Part(twin, Partition(k, count)) for k, twin in enumerate(twins)]
        # Reads no message: it has the names of the values, and rules of messages.
        self.source = plan.open(report) if plan.config.source.type == "push" else None
        self.store = None
        self.version = 0
        """Increases with each change of the table."""
        self.names: list[str] = []
        """Names of the assets; only appended to."""
        self._places: dict[str, int] = {}
        self._stopped = False
        self._lock = threading.Lock()
        self._shown = plan.fleet(1).table()
        self._pool = ThreadPoolExecutor(count, "partition")

    @property
    def twin(self) -> Twin:
        """The twin of each asset."""
        return replace(self.plan.twin, loaded=self.plan.source.loaded)

    @property
    def ended(self) -> bool:
        """Whether the source of each partition has ended."""
        return all(part.ended for part in self._parts)

    @property
    def failure(self) -> str:
        """Why a partition does not run, or empty."""
        failed = [part.twin for part in self._parts if part.twin.state == FAILED]
        return f"{failed[0].name}: {failed[0].text}" if failed else ""

    @property
    def starting(self) -> str:
        """The partitions that do not run yet, or empty."""
        waiting = [part.twin.name for part in self._parts if part.twin.state != RUNNING]
        return f"starting: {', '.join(waiting)}" if waiting else ""

    @property
    def counts(self) -> Counter[str]:
        """Reports by key."""
        total: Counter[str] = Counter()
        for part in self._parts:
            total.update(part.counts)
        return total

    def start(self) -> None:
        """Start the processes."""
        self._supervisor.start()

    def stop(self) -> None:
        """Take the last tables, and stop the processes."""
        if not self.ended:
            self.table()
        self._stopped = True
        self._supervisor.stop()
        self._pool.shutdown()

    def has_ended(self) -> bool:
        """Return whether all sources have ended.

        Raises:
            SourceError: If a partition cannot start.
        """
        for part in self._parts:
            if part.twin.state == FAILED and part.twin.refused:
                raise SourceError(part.twin.text)
        if not all(part.twin.report.get("ended", False) for part in self._parts):
            return False
        self.table()
        return self.ended

    def find(self, name: str) -> str | None:
        """Return the name of an asset if there is one of that name; from any thread."""
        return name if name in self._places else None

    def table(self) -> tuple[int, list[str], FleetTable]:
        """Return the version, the names, and the table of all assets, as far as their processes have answered."""
        with self._lock:
            if not self._stopped and any([*self._pool.map(self._update, self._parts)]):
                self._merge()
            names = self.names[:]
            return self.version, names, FleetTable(names, *self._shown[1:])

    def _update(self, part: _Part) -> bool:
        """Get the table of a partition; return whether it has changed."""
        start = part.twin.starts
        known = part.version[1] if part.version[0] == start else -1
        try:
            kind, body = part.request("GET", f"{TABLE_PATH}/{known}")
        except OSError:
            part.ended = False  # the last table is shown
            return False
        if kind == "application/json":
            head, columns = json.loads(body), None
        else:
            with np.load(io.BytesIO(body), allow_pickle=False) as file:
                columns = {name: file[name] for name in FleetTable._fields[1:]}
                head = json.loads(file["head"].tobytes())
        part.version, part.ended, part.counts = (start, head["version"]), head["ended"], head["counts"]
        if columns is None:
            return False
        part.columns, part.names = columns, head["names"]
        return True

    def _merge(self) -> None:
        for part in self._parts:
            for name in part.names:
                if self._places.setdefault(name, len(self.names)) == len(self.names):
                    self.names.append(name)
        count, columns = len(self.names), {}
        for name, empty in zip(FleetTable._fields[1:], self._shown[1:], strict=True):
            kinds = [part.columns[name].dtype for part in self._parts if part.columns] or [empty.dtype]
            fill = np.nan if empty.dtype.kind == "f" else "" if empty.dtype.kind == "U" else 0
            columns[name] = np.full((count, *empty.shape[1:]), fill, np.result_type(*kinds))
        for part in self._parts:
            at = np.array([self._places[name] for name in part.names], np.int64)
            for name, column in part.columns.items():
                columns[name][at] = column
        self._shown = FleetTable(self.names, **columns)
        self.version += 1

    async def take(self, messages: Sequence[Any]) -> dict[str, Any]:
        """Send each message to the process of its asset; answer what became of each."""
        rows: dict[int, list[int]] = {}
        for k, message in enumerate(messages):
            rows.setdefault(self._number(message), []).append(k)
        sent = [partial(self._send, self._parts[number], [messages[k] for k in own]) for number, own in rows.items()]
        found = await asyncio.gather(*map(in_thread, sent))
        answers = [Answer(REFUSED)] * len(messages)
        for own, (taken, _) in zip(rows.values(), found, strict=True):
            for k, one in zip(own, taken, strict=True):
                answers[k] = one
        return readings.summary(answers) | {"stored": bool(found) and all(stored for _, stored in found)}

    def _number(self, message: Any) -> int:
        """Return the number of the partition of a message; 0 for one without an asset, which is refused there."""
        asset = message.get(ASSET) if isinstance(message, Mapping) else None
        if not isinstance(asset, str):
            return 0
        return next(k for k, part in enumerate(self._parts) if part.partition.has(asset))

    def _send(self, part: _Part, messages: list[Any]) -> tuple[list[Answer], bool]:
        try:
            _, body = part.request("POST", READINGS_PATH, json.dumps(messages).encode())
        except OSError as error:
            return [Answer(REFUSED, f"{error}; send it again")] * len(messages), False
        found = json.loads(body)
        return [Answer(item["status"], item.get("reason", "")) for item in found["items"]], found["stored"]
