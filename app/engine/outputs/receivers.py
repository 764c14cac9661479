"""Receivers of alerts, which are extensions, and the queue of each.

Each receiver has a queue and takes its alerts in a thread of its own pool, so that a dead one delays neither the twin
nor the others.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from config.extensions import maker
from config.output_schema import ReceiverSection
from estimators.errors import printable
from sources.worker_process import gist

from ...twin.secrets import Secrets
from ..jobs import Job, Jobs
from ..notices import Notices
from .alerts import FIRING, HEARTBEAT, AlertMessage, heartbeat

MAX_WAITING_ALERTS = 100
"""Alerts that wait for a receiver; then the oldest is dropped."""

DELIVERY_PERIOD_S, MAX_RETRY_S = 0.2, 60.0
"""Between two looks at the queue of a receiver, and the longest wait after it has failed."""

TIMEOUT_S = 10.0
"""Longest time of a request to a server."""


class Receiver(Protocol):
    """Sends alerts to one place."""

    def send(self, alert: AlertMessage) -> None:
        """Send one, within seconds.

        Raises:
            OSError: If it was not received.
        """


class Delivery:
    """Queue of one receiver; `step` is a repeated job."""

    def __init__(self, name: str, receiver: Receiver, notices: Notices) -> None:
        self.name, self._receiver, self._notices = name, receiver, notices
        self._waiting: deque[AlertMessage] = deque()
        self._lock = threading.Lock()
        self._failures = 0
        self.delivered = self.dropped = 0

    @property
    def failing(self) -> bool:
        """Whether the last attempt failed."""
        return self._failures > 0

    @property
    def waiting(self) -> int:
        """Alerts that wait."""
        return len(self._waiting)

    @property
    def alerts(self) -> list[AlertMessage]:
        """Alerts that wait, the oldest first."""
        with self._lock:
            return list(self._waiting)

    def put(self, alert: AlertMessage) -> None:
        """Add an alert to the queue; of a full one the oldest is dropped."""
        with self._lock:
            if alert.status == HEARTBEAT and self._waiting:
                return
            if len(self._waiting) >= MAX_WAITING_ALERTS:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(alert)

    def step(self, job: Job | None = None) -> float:
        """Send the alerts that wait, in order; return the seconds until the next call."""
        while self._waiting and (job is None or job.wanted):
            alert = self._waiting[0]
            try:
                self._receiver.send(alert)
            except Exception as error:  # noqa: BLE001  an answer of no protocol, or what a program prints
                return self._failed(error)
            with self._lock:
                # A full queue may have dropped it meanwhile.
                if self._waiting and self._waiting[0] is alert:
                    self._waiting.popleft()
            self.delivered += 1
            if self._failures:
                self._notices.say(f"alerts: receiver {self.name} takes them again")
                self._failures = 0
        return DELIVERY_PERIOD_S

    def _failed(self, error: Exception) -> float:
        self._failures += 1
        pause = min(MAX_RETRY_S, 2.0 ** min(self._failures - 1, 10))
        # One line an outage; each failure is counted.
        self._notices.count("alert receiver")
        if self._failures == 1:
            text = printable(gist(error))
            self._notices.say(f"alerts: receiver {self.name} fails ({text}); they wait, and it is tried again", "warn")
        return pause


class Deliveries:
    """Queues of all receivers, and their messages that a twin or fleet runs."""

    def __init__(
        self,
        sections: Mapping[str, ReceiverSection],
        folder: Path,
        outputs: Mapping[str, Any],
        notices: Notices,
        secrets: Secrets,
    ) -> None:
        """Make the receivers.

        Args:
            sections: Receivers of the YAML by name.
            folder: Folder of the YAML.
            outputs: The outputs by key, of which one is the receiver of its name.
            notices: Where alerts and failures are reported.
            secrets: See `secrets_of`.
        """
        self._notices = notices
        made = make_receivers(sections, folder, outputs, secrets)
        self.queues = {name: Delivery(name, item, notices) for name, item in made.items()}
        periods = {name: getattr(item, "heartbeat", None) for name, item in sections.items()}
        self._periods = {name: period for name, period in periods.items() if period is not None}
        self._beats: dict[str, float] = {}

    def names(self, to: Sequence[str] | None) -> list[str]:
        """Return the names of the receivers that are meant by `to` of a rule, which may be of an earlier YAML."""
        return [name for name in self.queues if to is None or name in to]

    def counts(self) -> list[tuple[int, int]]:
        """Return how many alerts each receiver has taken, and lost."""
        return [(queue.delivered, queue.dropped) for queue in self.queues.values()]

    def waiting(self) -> list[tuple[str, AlertMessage]]:
        """Return the alerts that wait, each with the name of its receiver."""
        return [
            (name, alert) for name, queue in self.queues.items() for alert in queue.alerts if alert.status != HEARTBEAT
        ]

    def restore(self, waiting: Sequence[tuple[str, AlertMessage]]) -> None:
        """Add alerts that waited in an earlier process, or under an earlier YAML."""
        for name, alert in waiting:
            if name in self.queues:
                self.queues[name].put(alert)

    def deliver(self, alert: AlertMessage, names: Sequence[str]) -> None:
        """Report an alert, and add it to the queues of the receivers of these names."""
        self._notices.say(f"alert {alert.status}: {alert.text}", level="warn" if alert.status == FIRING else "info")
        for name in names:
            self.queues[name].put(alert)

    def beat(self, twin: str, health: str) -> None:
        """Add the messages that it runs, where they are due."""
        now = time.monotonic()
        for name, period in self._periods.items():
            if now - self._beats.get(name, -math.inf) >= period:
                self._beats[name] = now
                self.queues[name].put(heartbeat(twin, health))

    def run(self, jobs: Jobs) -> None:
        """Deliver in threads of a pool."""
        for queue in self.queues.values():
            jobs.run(f"alerts to {queue.name}", queue.step, every=DELIVERY_PERIOD_S)


def make_receivers(
    sections: Mapping[str, ReceiverSection], folder: Path, outputs: Mapping[str, Any], secrets: Secrets
) -> dict[str, Receiver]:
    """Return the receivers by name."""
    found: dict[str, Receiver] = {}
    for name, section in sections.items():
        own = section.type in outputs
        found[name] = outputs[section.type] if own else maker("receivers", section.type)(section, folder, secrets)
    return found
