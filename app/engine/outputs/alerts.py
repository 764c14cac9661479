"""Alerts: rules on health, episodes, NIS, limits of states and loss of the twin.

A condition that lasts is one alert: firing, repeated after a time, resolved. See receivers.py for their delivery.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from config.output_schema import AlertSection
from estimators.diagnostics.detectors import anchor
from estimators.errors import printable
from estimators.track import HEALTH_NAMES, WAITING

from ...result import JsonObject
from ..engine import Engine
from .alarm_guide import advice
from .state_message import StateMessage, iso_now

SCHEMA: Literal["nisus.alert/1"] = "nisus.alert/1"

FIRING, REPEATED, RESOLVED, HEARTBEAT = "firing", "repeated", "resolved", "heartbeat"

SETTLE_S = 10.0
"""Seconds after a restart, or of an estimate that is known again, until a condition that does not hold counts towards
`clear`: the log is folded again, and episodes are sought in it."""

GUIDES = LIMIT_GUIDE, NIS_GUIDE, LOST_GUIDE = "limit of a state", "nis above its limit", "loss of the twin"
"""Headings in docs/alarms.md of alerts that are no health and no cause of an episode."""


class AlertMessage(BaseModel):
    """One alert, as receivers get it."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    version: Literal["nisus.alert/1"] = SCHEMA
    twin: str
    id: str = Field(description="equal in all messages of one alert; another for the next alert of the same rule")
    status: Literal["firing", "repeated", "resolved", "heartbeat"]
    rule: str
    subject: str = Field(description="sensor or state concerned, or twin")
    text: str = Field(description="one line: what happened, value and limit")
    health: str
    since: str = Field(description="beginning of the condition, ISO 8601 in UTC, by the clock of this machine")
    sent: str = Field(description="time of this message, likewise")
    value: float | None = Field(default=None, description="estimate or NIS concerned, null if there is none")
    std: float | None = Field(default=None, description="standard deviation of the estimate")
    limit: float | None = None
    probability: float | None = Field(default=None, description="that the state is beyond the limit")
    unit: str = ""
    guide: str = Field(description="section of the guide with diagnosis and response")
    link: str | None = Field(default=None, description="the same on the page of the twin; null without a page")
    response: str = Field(default="", description="response by the guide")


def alert_schema() -> JsonObject:
    """Return the JSON Schema of an alert."""
    return AlertMessage.model_json_schema(mode="serialization")


class Finding(NamedTuple):
    """A condition of a rule that holds."""

    subject: str
    text: str
    guide: str
    value: float | None = None
    std: float | None = None
    limit: float | None = None
    probability: float | None = None
    unit: str = ""
    key: str = ""


def findings(rule: AlertSection, engine: Engine, message: StateMessage) -> Iterator[Finding]:
    """Yield the conditions of a rule that hold for a state."""
    if rule.health is not None and HEALTH_NAMES.index(message.health) >= HEALTH_NAMES.index(rule.health):
        leading = next((item for item in engine.episodes() if item.end is None and item.text == message.cause), None)
        guide = message.health if leading is None else leading.cause
        yield Finding("twin", f"{message.health}: {message.cause or 'see the guide'}", guide)
    if rule.episode is not None:
        for item in engine.episodes():
            if item.end is None and ("all" in rule.episode or item.cause in rule.episode):
                size = item.size if math.isfinite(item.size) else None
                key = f"{item.cause} {item.start}"
                yield Finding(item.subject, item.text, item.cause, value=size, unit=item.unit, key=key)
    if rule.nis is not None and message.nis is not None and message.nis > rule.nis:
        text = f"NIS is {message.nis:.2f} times its expected value, above {rule.nis:g}"
        yield Finding("twin", text, NIS_GUIDE, value=message.nis, limit=rule.nis)
    if rule.state is not None:
        limit = rule.above if rule.above is not None else rule.below
        assert limit is not None
        for state in message.states:
            if state.name == rule.state and state.value is not None and state.std is not None:
                over = state.value - limit if rule.above is not None else limit - state.value
                probability = tail(over, state.std)
                if probability >= rule.probability:
                    side = "above" if rule.above is not None else "below"
                    text = f"{state.name} is {state.value:.4g} ± {state.std:.2g} {state.unit}, with {probability:.1%} "
                    text += f"{side} {limit:g} {state.unit}"
                    numbers = state.value, state.std, limit, probability, state.unit
                    yield Finding(state.name, text, LIMIT_GUIDE, *numbers)
    if rule.lost is not None and message.age_s is not None and message.age_s > rule.lost:
        yield Finding("twin", f"nothing has come for {message.age_s:.0f} s", LOST_GUIDE, value=message.age_s, unit="s")


def tail(over: float, std: float) -> float:
    """Return the probability that a Gaussian of this deviation, whose mean is `over` a limit, is beyond it."""
    if std == 0.0:
        return float(over > 0.0)
    return 0.5 * math.erfc(-over / (std * math.sqrt(2.0)))


def numbered(titles: Sequence[str]) -> list[tuple[str, str]]:
    """Return the titles of rules, each after its number among equal ones."""
    return [(str(titles[:k].count(title)), title) for k, title in enumerate(titles)]


class OpenAlert:
    """A condition from its beginning until its end is certain. Times are monotonic, s."""

    def __init__(self, key: tuple[str, ...], rule: AlertSection, finding: Finding, now: float) -> None:
        self.rule, self.finding = rule, finding
        self.begun = self.seen = now
        self.since = iso_now()
        self.id = hashlib.sha256("|".join((*key, self.since)).encode()).hexdigest()[:16]
        self.sent: float | None = None
        self.removed = False
        """Whether its rule is no longer in the YAML."""


class AlertRules:
    """Decides which alerts to send; not for several threads at once."""

    message = AlertMessage
    """Type of the messages."""

    def __init__(
        self, rules: Sequence[AlertSection], *, link: str | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """`link`: address of the page, without the token; `clock` returns seconds."""
        self._rules = dict(zip(numbered([rule.title for rule in rules]), rules, strict=True))
        self._link, self._clock = link, clock
        self._open: dict[tuple[str, ...], OpenAlert] = {}
        self._version: int | None = None
        self._maintained = -math.inf

    @property
    def open(self) -> tuple[OpenAlert, ...]:
        """Alerts that were sent and are not resolved, oldest first."""
        return tuple(item for item in self._open.copy().values() if item.sent is not None)

    def evaluate(self, engine: Engine, message: StateMessage) -> list[tuple[AlertSection, AlertMessage]]:
        """Return the messages to send now, each with its rule.

        Conditions of an estimate that is not known, because the state is waiting, neither begin nor end.
        """
        now, due = self._clock(), []
        if self._version is not None and message.model_version > self._version:
            self._maintained = now
        self._version = message.model_version
        holding: set[tuple[str, ...]] = set()
        for name, rule in self._rules.items():
            for found in findings(rule, engine, message):
                key = *name, found.subject, found.key
                entry = self._open.setdefault(key, OpenAlert(key, rule, found, now))
                entry.rule, entry.finding, entry.seen = rule, found, now
                holding.add(key)
        muted = engine.mute is not None and engine.mute.active
        for place, entry in list(self._open.items()):
            rule = entry.rule
            quiet = muted or now - self._maintained < rule.maintenance
            lasts = place in holding
            known = message.health != HEALTH_NAMES[WAITING] if rule.lost is None else message.age_s is not None
            if not (lasts or known):
                entry.seen = max(entry.seen, now + SETTLE_S)
            over = not lasts and now - entry.seen >= rule.clear
            if over and (entry.sent is None or not quiet):
                del self._open[place]
                if entry.sent is not None:
                    due.append((rule, self._message(entry, RESOLVED, message)))
            elif lasts and not quiet and now - entry.begun >= rule.after:
                first = entry.sent is None
                again = rule.repeat != "never" and entry.sent is not None and now - entry.sent >= rule.repeat
                if first or again:
                    entry.sent = now
                    due.append((rule, self._message(entry, FIRING if first else REPEATED, message)))
        return due

    def state(self) -> list[JsonObject]:
        """Return the open alerts, for JSON."""
        now = self._clock()
        return [
            {"key": key, "rule": entry.rule.model_dump(mode="json", exclude_unset=True), "finding": entry.finding,
             "id": entry.id, "since": entry.since, "sent": now - entry.sent}
            for key, entry in self._open.items() if entry.sent is not None
        ]  # fmt: skip

    def restore(self, state: Sequence[JsonObject], ago: float) -> None:
        """Continue with the open alerts of `state`, which was returned some seconds `ago`.

        That of a rule which is no longer there is resolved.
        """
        now, found = self._clock(), {}
        for item in state:
            key, rule = tuple(map(str, item["key"])), AlertSection.model_validate(item["rule"])
            entry = found[key] = OpenAlert(key, rule, Finding(*item["finding"]), now)
            entry.id, entry.since, entry.sent = str(item["id"]), str(item["since"]), now - ago - item["sent"]
            entry.begun, entry.seen = -math.inf, now + SETTLE_S
            entry.removed = key[:2] not in self._rules
        self._open.update(found)

    def _message(self, entry: OpenAlert, status: Any, message: StateMessage) -> AlertMessage:
        found, place = entry.finding, anchor(entry.finding.guide)
        text = printable(found.text)
        if status == RESOLVED:
            text = f"the rule {entry.rule.title} was removed: {text}" if entry.removed else f"no longer: {text}"
        return AlertMessage(
            twin=message.twin,
            id=entry.id,
            status=status,
            rule=entry.rule.title,
            subject=found.subject,
            text=text,
            health=message.health,
            since=entry.since,
            sent=iso_now(),
            value=found.value,
            std=found.std,
            limit=found.limit,
            probability=found.probability,
            unit=found.unit,
            guide=f"docs/alarms.md#{place}",
            link=None if self._link is None else f"{self._link}/alarms#{place}",
            response=advice(found.guide, "Response"),
        )


def heartbeat(twin: str, health: str) -> AlertMessage:
    """Return the message that a twin runs."""
    return AlertMessage(
        twin=twin,
        id=HEARTBEAT,
        status=HEARTBEAT,  # type: ignore[arg-type]
        rule=HEARTBEAT,
        subject="twin",
        text="the twin runs",
        health=health,
        since=iso_now(),
        sent=iso_now(),
        guide=f"docs/alarms.md#{anchor(LOST_GUIDE)}",
    )
