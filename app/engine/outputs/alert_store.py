"""Open alerts, and those that wait for receivers, in a file beside the store of a twin or fleet.

An alert is written before it is sent, so after a restart it has the same id: it is neither begun again nor forgotten.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol

from estimators.errors import NisusError, SourceError

from ..notices import Notices
from ..store import RETRY_PERIOD_S, Store
from .alerts import AlertMessage
from .receivers import Deliveries

SUFFIX = ".alerts"
"""Follows the name of the store."""

BLOCK = "alerts", 0
"""Kind and number of the only block of the file."""


class StoredRules(Protocol):
    """Rules whose open alerts can be kept."""

    @property
    def message(self) -> type[AlertMessage]:
        """Type of their messages."""

    def state(self) -> list[Any]:
        """Return the open alerts for JSON."""

    def restore(self, state: Sequence[Any], ago: float) -> None:
        """Continue with the open alerts of `state`, which was returned some seconds `ago`."""


class AlertStore:
    """The file; without a path nothing is kept. Not for several threads at once."""

    def __init__(self, store: Path | None, owner: str, notices: Notices) -> None:
        """`store`: of the twin or fleet whose name is `owner`; nothing is opened yet."""
        self._path = None if store is None else store.with_name(store.name + SUFFIX)
        self._owner, self._notices = owner, notices
        self._store: Store | None = None
        self._written: object = None
        """Counts of the receivers at the last write; None if it failed, or nothing was written."""
        self._retry: float | None = None

    def open(self, rules: StoredRules, deliveries: Deliveries) -> str:
        """Open the file and continue with its alerts; return why it cannot be used, or empty."""
        if self._path is None or self._store is not None:
            return ""
        store = None
        try:
            store = Store(self._path)
            data = store.read_blocks().get(BLOCK)
            if data is not None:
                self._continue(json.loads(data), rules, deliveries)
        except Exception as error:  # noqa: BLE001  a file may hold anything; alerts are sent without it
            if store is not None:
                store.close()
            known = isinstance(error, NisusError)
            reason = str(error) if known else f"cannot be continued ({type(error).__name__}); remove it"
            text = f"{reason if known else f'store {self._path}: {reason}'}; alerts are not kept over a restart"
            self._notices.say(text, level="warn")
            self._path = None  # it stays as it is
            return text
        self._store = store
        return ""

    def _continue(self, kept: dict[str, Any], rules: StoredRules, deliveries: Deliveries) -> None:
        if kept["of"] != self._owner:
            raise SourceError(f"store {self._path}: is of {kept['of']}; remove it, or choose another path")
        # First what may fail halfway.
        waiting = [(name, rules.message(**item)) for name, item in kept["waiting"]]
        rules.restore(kept["open"], max(0.0, time.time() - kept["written"]))
        deliveries.restore(waiting)

    def send(self, rules: StoredRules, deliveries: Deliveries, due: Iterable[tuple[Any, AlertMessage]]) -> None:
        """Put alerts, each with its rule, into the queues of their receivers, once they are in the file."""
        meant = [(alert, deliveries.names(rule.to)) for rule, alert in due]
        counts = deliveries.counts()
        if meant or counts != self._written:
            self._write(rules, deliveries, meant, counts)
        for alert, names in meant:
            deliveries.put(alert, names)

    def _write(
        self, rules: StoredRules, deliveries: Deliveries, due: Sequence[tuple[AlertMessage, Sequence[str]]], counts: Any
    ) -> None:
        if self._store is None or (self._retry is not None and time.monotonic() < self._retry):
            return
        waiting = [*deliveries.waiting(), *((name, alert) for alert, names in due for name in names)]
        kept = {
            "of": self._owner,
            "written": time.time(),
            "open": rules.state(),
            "waiting": [(name, alert.model_dump(mode="json")) for name, alert in waiting],
        }
        try:
            self._store.write_blocks({BLOCK: json.dumps(kept).encode()})
        except SourceError as error:
            if self._retry is None:
                self._notices.say(f"{error}; alerts are sent without it, and it is tried again", level="error")
            self._written, self._retry = None, time.monotonic() + RETRY_PERIOD_S
            return
        if self._retry is not None:
            self._notices.say(f"store {self._path}: it is written again")
        self._written, self._retry = counts, None

    def close(self, rules: StoredRules, deliveries: Deliveries) -> None:
        """Write the rest, and close the file."""
        if self._store is not None:
            self._retry = None
            self.send(rules, deliveries, ())
            self._store.close()
            self._store = None
