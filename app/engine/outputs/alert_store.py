"""Open alerts, and those that wait for receivers, in the store of a twin or fleet.

An alert is written before it is sent, so after a restart it has the same id: it is neither begun again nor forgotten.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Sequence
from typing import Any, Protocol

from estimators.errors import NisusError, SourceError

from ..notices import Notices
from ..store import ALERTS, RETRY_PERIOD_S, Store
from .alerts import AlertMessage
from .receivers import Deliveries


class StoredRules(Protocol):
    """Rules whose open alerts can be kept."""

    @property
    def message(self) -> type[AlertMessage]:
        """Type of their messages."""

    def state(self) -> Sequence[object]:
        """Return the open alerts for JSON."""

    def restore(self, state: Sequence[Any], ago: float) -> None:
        """Continue with the open alerts of `state`, which was returned some seconds `ago`."""


class AlertStore:
    """Part of a store; without one nothing is kept. Not for several threads at once."""

    def __init__(self, store: Store | None, notices: Notices) -> None:
        """`store`: of the twin or fleet."""
        self._unread, self._notices = store, notices
        self._store: Store | None = None
        self._written: object = None
        """Counts of the receivers at the last write; None if it failed, or nothing was written."""
        self._retry = 0.0
        """When to try again after a failure, monotonic, s; 0 without one."""

    def open(self, rules: StoredRules, deliveries: Deliveries) -> str:
        """Keep the alerts of these rules and receivers, and continue with those of the store, if it is not read yet.

        Return why it cannot be used, or empty.
        """
        self._rules, self._deliveries = rules, deliveries
        store, self._unread = self._unread, None
        if store is None:
            return ""
        try:
            _adopt(store)
            for data in store.read_blocks(ALERTS).values():
                kept = json.loads(data)
                # First what may fail halfway.
                waiting = [(name, rules.message(**item)) for name, item in kept["waiting"]]
                rules.restore(kept["open"], max(0.0, time.time() - kept["written"]))
                deliveries.restore(waiting)
        except Exception as error:  # noqa: BLE001  a file may hold anything; alerts are sent without it
            text = f"store {store.path}: cannot be continued ({type(error).__name__}); remove it"
            text = str(error) if isinstance(error, NisusError) else text
            text += "; alerts are not kept over a restart"
            self._notices.say(text, level="warn")
            return text  # they stay as they are
        self._store = store
        return ""

    def send(self, due: Iterable[tuple[Any, AlertMessage]]) -> None:
        """Put alerts, each with its rule, into the queues of their receivers, once they are in the store."""
        meant = [(alert, self._deliveries.names(rule.to)) for rule, alert in due]
        if meant or self._deliveries.counts() != self._written:
            self._write(meant)
        for alert, names in meant:
            self._deliveries.deliver(alert, names)

    def _write(self, due: Sequence[tuple[AlertMessage, Sequence[str]]]) -> None:
        if self._store is None or time.monotonic() < self._retry:
            return
        counts = self._deliveries.counts()
        waiting = [*self._deliveries.waiting(), *((name, alert) for alert, names in due for name in names)]
        kept = {
            "written": time.time(),
            "open": self._rules.state(),
            "waiting": [(name, alert.model_dump(mode="json")) for name, alert in waiting],
        }
        try:
            self._store.write_blocks({(ALERTS, 0): json.dumps(kept).encode()})
        except SourceError as error:
            if not self._retry:
                self._notices.say(f"{error}; alerts are sent without it, and it is tried again", level="error")
            self._written, self._retry = None, time.monotonic() + RETRY_PERIOD_S
            return
        if self._retry:
            self._notices.say(f"store {self._store.path}: it is written again")
        self._written, self._retry = counts, 0.0

    def close(self) -> None:
        """Write the rest; the store stays open."""
        if self._store is not None:
            self._retry = 0.0
            self.send(())
            self._store = None


def _adopt(store: Store) -> None:
    """Move the alerts of an earlier version from their own file, beside that of the store, into the store."""
    path = store.path.with_name(f"{store.path.name}.alerts")
    if path.is_file():
        before = Store(path)
        store.write_blocks(before.read_blocks(ALERTS))
        before.close()
        path.unlink()
