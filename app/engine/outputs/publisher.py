"""The estimate for other programs: brokers, servers, buses and receivers of alerts.

A thread of its own waits for new rows, makes one message, and hands it to every output, none of which may block.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np

from config.extensions import maker, schemas
from config.output_schema import AlertSection
from config.schema import TwinSection
from estimators.errors import ConfigError, NisusError, printable

from ...result import JsonObject
from ...twin.secrets import secrets_of
from ..copies import OutputLink
from ..engine import Engine
from ..jobs import Jobs, LoopThread
from ..store import Store
from .alert_store import AlertStore
from .alerts import AlertRules
from .receivers import Deliveries
from .state_message import StateMessage, state_message

T = TypeVar("T")

ALIVE_PERIOD_S = 1.0
"""Between two messages of a state that does not change: its age does."""

HEALTH_RULE = AlertSection(health="suspect")
"""Rule of a twin that has receivers and no rules."""

FAILED = OutputLink(False, "it fails; see the notices")
"""Of an output that cannot tell."""

RULES_PERIOD_S = 0.2
"""Between two looks at the rules of alerts."""


@runtime_checkable
class Output(Protocol):
    """Publishes states; no method may wait for a client or a network."""

    name: str

    def start(self) -> None:
        """Begin to connect or to serve."""

    def publish(self, message: StateMessage) -> None:
        """Publish a state, or drop it if that is not possible now."""

    def stop(self) -> None:
        """Disconnect, within a second."""

    def link(self) -> OutputLink:
        """Return whether clients are reached."""


class Parts(NamedTuple):
    """Outputs, rules and receivers of one version of the twin's YAML."""

    config: TwinSection
    outputs: tuple[Output, ...]
    rules: AlertRules
    deliveries: Deliveries
    jobs: Jobs


class Publisher:
    """Outputs and alerts of one running twin, as its YAML asks for them."""

    def __init__(self, engine: Engine, *, page: str | None = None, store: Store | None = None) -> None:
        """Prepare; nothing is connected yet.

        Args:
            engine: The running twin.
            page: Address of its page, without the token; None without one.
            store: Its store, in which the open alerts are kept; None for none.

        Raises:
            NisusError: If a package or a secret is missing.
        """
        self._engine, self._page = engine, page
        self._parts = self._make()
        self._store = AlertStore(store, engine.notices)
        self.problem = ""
        """Why alerts are not kept, once it has started; empty if they are, or without a store."""
        self._grown = threading.Event()
        self._thread = LoopThread(self._run, "outputs")

    def start(self) -> None:
        """Connect and begin to publish."""
        self._begin()
        self._engine.grown |= {self._awake}

    def stop(self) -> None:
        """Disconnect."""
        self._engine.grown -= {self._awake}
        self._thread.stop(2.0, self._grown.set)
        self._end()
        self._store.close()

    def json(self) -> JsonObject:
        """Return the state of outputs, receivers and alerts."""
        parts, mute = self._parts, self._engine.mute
        links = [self._guarded(item, item.link) or FAILED for item in parts.outputs]
        return {
            "outputs": [{"name": item.name} | link._asdict() for item, link in zip(parts.outputs, links, strict=True)],
            "receivers": [
                {name: getattr(item, name) for name in ("name", "failing", "waiting", "delivered", "dropped")}
                for item in parts.deliveries.queues.values()
            ],
            "alerts": [
                {"id": item.id, "rule": item.rule.title, "subject": item.finding.subject, "since": item.since}
                | {"text": item.finding.text}
                for item in parts.rules.open
            ],
            "muted_s": 0.0 if mute is None else mute.seconds,
            "mute_reason": mute.reason if mute is not None and mute.active else "",
        }

    def _make(self) -> Parts:
        twin, notices = self._engine.twin, self._engine.notices
        section, rules = twin.config.outputs, twin.config.alerts
        secrets = secrets_of(section, twin.loaded.places)
        outputs: dict[str, Output] = {
            key: maker("outputs", key)(own, self._engine, secrets)
            for key in schemas("outputs")
            if (own := getattr(section, key, None)) is not None
        }
        for key, output in outputs.items():
            if not isinstance(output, Output):
                raise ConfigError(f"outputs.{key}: its extension must make name, start, publish, stop and link")
        deliveries = Deliveries(section.receivers, twin.path.absolute().parent, outputs, notices, secrets)
        if deliveries.queues and not rules:
            rules = (HEALTH_RULE,)
        jobs = Jobs(notices, "output", threads=1 + len(deliveries.queues), niceness=0)
        return Parts(twin.config, tuple(outputs.values()), AlertRules(rules, link=self._page), deliveries, jobs)

    def _begin(self) -> None:
        parts = self._parts
        for output in parts.outputs:
            self._guarded(output, output.start)
        if parts.deliveries.queues:
            self.problem = self._store.open(parts.rules, parts.deliveries)
            parts.jobs.run("alerts", lambda job: self._look(parts), every=RULES_PERIOD_S)
        parts.deliveries.run(parts.jobs)
        parts.jobs.start()

    def _end(self) -> None:
        self._parts.jobs.stop()
        for output in self._parts.outputs:
            self._guarded(output, output.stop)

    def _awake(self) -> None:
        """Wake the thread, which begins with the first output or another YAML; on the engine's thread."""
        if self._parts.outputs or self._engine.twin.config is not self._parts.config:
            if not self._thread.is_alive():
                self._thread.start()
            self._grown.set()

    def _run(self) -> None:
        sent, at = None, -np.inf
        while not self._thread.stopping.is_set():
            self._grown.wait(ALIVE_PERIOD_S)
            self._grown.clear()
            self._follow()
            parts = self._parts
            if self._thread.stopping.is_set() or not parts.outputs:
                continue
            section = parts.config.outputs
            message = state_message(self._engine, covariance=section.covariance)
            new, now = (message.time_ns, message.revision, message.health, message.cause), time.monotonic()
            if new == sent and now - at < ALIVE_PERIOD_S:
                continue
            sent, at = new, now
            for output in parts.outputs:
                self._guarded(output, partial(output.publish, message))
            self._thread.stopping.wait(section.every)

    def _follow(self) -> None:
        """Begin again with the outputs of the YAML that was saved meanwhile."""
        config, old = self._engine.twin.config, self._parts.config
        if (config.outputs, config.alerts) == (old.outputs, old.alerts):
            self._parts = self._parts._replace(config=config)
            return
        try:
            parts = self._make()
        except NisusError as error:
            self._engine.notices.say(f"the outputs stay as they were: {error}", level="error")
            self._parts = self._parts._replace(config=config)
            return
        self._end()
        before = self._parts
        parts.rules.restore(before.rules.state(), 0.0)
        parts.deliveries.restore(before.deliveries.waiting())
        self._parts = parts
        self._begin()

    def _guarded(self, output: Output, work: Callable[[], T]) -> T | None:
        """Return the result of a method of an output; None if it fails, which is reported."""
        try:
            return work()
        except Exception as error:  # noqa: BLE001  no client or library may end the thread of all outputs
            name, reason = f"output {output.name}", printable(f"{type(error).__name__}: {error}".partition("\n")[0])
            self._engine.notices.report(name, f"{name}: {reason}", level="error")
            return None

    def _look(self, parts: Parts) -> None:
        """Put the alerts that are due into the queues of their receivers."""
        message = state_message(self._engine)
        self._store.send(parts.rules.evaluate(self._engine, message))
        parts.deliveries.beat(message.twin, message.health)
