"""The estimates and alerts of a fleet for other programs, from a thread of their own."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from app.engine.jobs import Jobs, LoopThread
from app.engine.notices import Notices
from app.engine.outputs.alert_store import AlertStore
from app.engine.outputs.receivers import Deliveries
from app.terminal import print_line
from app.twin.secrets import secrets_of
from estimators.fleet.table import FleetTable
from estimators.track import HEALTH_NAMES

from .alerts import FleetRules
from .schema import FleetAlertSection
from .state import ChangedAssets, asset_message

if TYPE_CHECKING:
    from app.extensions.mqtt.output import MqttOutput

    from .running import RunningFleet

HEALTH_RULE = FleetAlertSection(health="degraded")
"""Rule of a fleet that has receivers and no rules."""

POLL_S = 0.002
"""Between two looks at a connection that takes no state."""


class FleetPublisher:
    """Outputs and alerts of a running fleet, as its YAML asks for them."""

    def __init__(self, fleet: RunningFleet, *, page: str | None = None) -> None:
        """Prepare; nothing is connected yet.

        Args:
            fleet: The running fleet.
            page: Address of its overview, without the token; None without one.

        Raises:
            NisusError: If a package or a secret is missing.
        """
        plan = fleet.plan
        section, rules = plan.config.outputs, plan.config.alerts
        self._fleet, self._section = fleet, section
        self.notices = Notices(time.time_ns)
        self._next_line = 0
        folder = plan.path.absolute().parent
        secrets = secrets_of(section, plan.source.loaded.places)
        self._mqtt: MqttOutput | None = None
        self._changed, self._connections = ChangedAssets(), 0
        if section.mqtt is not None:
            from app.extensions.mqtt.output import MqttOutput

            notices, model = self.notices, lambda: plan.twin.model
            self._mqtt = MqttOutput(section.mqtt, plan.name, model, notices, secrets, of_assets=True)
        self._deliveries = Deliveries(section.receivers, folder, {"mqtt": self._mqtt}, self.notices, secrets)
        self._rules = FleetRules(rules or (HEALTH_RULE,), plan.name, link=page)
        self._store = AlertStore(fleet.file, self.notices)
        self._jobs = Jobs(self.notices, "output", threads=max(1, len(self._deliveries.queues)), niceness=0)
        self._thread = LoopThread(self._run, "outputs")

    def start(self) -> None:
        """Connect and begin to publish."""
        if self._mqtt is not None:
            self._mqtt.start()
        elif not self._deliveries.queues:
            return
        if self._deliveries.queues:
            self._store.open(self._rules, self._deliveries)
        self._deliveries.run(self._jobs)
        self._jobs.start()
        self._thread.start()

    def stop(self) -> None:
        """Disconnect."""
        self._thread.stop(2.0)
        self._jobs.stop()
        self._store.close()
        if self._mqtt is not None:
            self._mqtt.stop()
        self._print()

    def _run(self) -> None:
        due = time.monotonic()
        while not self._thread.stopping.wait(max(0.0, due - time.monotonic())):
            due = time.monotonic() + self._section.every
            try:
                _, names, table = self._fleet.table()
                if names:
                    if self._deliveries.queues:
                        self._alert(names, table)
                    if self._mqtt is not None:
                        self._publish(self._mqtt, names, table, due)
            except Exception as error:  # noqa: BLE001  no library or broken table may end the thread of all outputs
                self.notices.report("engine error", f"outputs: {type(error).__name__}: {error}", level="error")
            self._print()

    def _publish(self, mqtt: MqttOutput, names: Sequence[str], table: FleetTable, due: float) -> None:
        """Publish the states that have changed, as many as the connection takes until the next table is due."""
        if mqtt.connections != self._connections:  # what was on its way is lost, and the broker may have none
            self._changed, self._connections = ChangedAssets(), mqtt.connections
        self._changed.update(table)
        while mqtt.link().connected and not self._thread.stopping.is_set():
            places = self._changed.pop(room := mqtt.room)
            for place in places:
                mqtt.publish(asset_message(self._fleet.plan.twin, names[place], table, place))
            if (room and len(places) < room) or time.monotonic() >= due:
                return
            self._thread.stopping.wait(POLL_S)

    def _alert(self, names: Sequence[str], table: FleetTable) -> None:
        """Put the alerts that are due into the queues of their receivers."""
        self._store.send(self._rules.evaluate(names, table))
        if not self._fleet.failure:  # a fleet that stands still does not tell that it runs
            self._deliveries.beat(self._fleet.plan.name, HEALTH_NAMES[table.health.max()])

    def _print(self) -> None:
        for line in self.notices.since(self._next_line):
            print_line(line.level, line.text)
            self._next_line = line.number + 1
