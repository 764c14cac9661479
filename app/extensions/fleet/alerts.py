"""Alerts on the health of many assets: those in alarm at a moment are one message, not one each."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from app.engine.outputs.alarm_guide import advice
from app.engine.outputs.alerts import FIRING, REPEATED, RESOLVED, SETTLE_S, AlertMessage, numbered
from app.engine.outputs.state_message import iso_now
from app.format_time import counted
from app.result import JsonObject
from estimators.diagnostics.detectors import anchor
from estimators.errors import printable
from estimators.fleet.table import FleetTable
from estimators.track import HEALTH_NAMES, TRACKING, WAITING

from .schema import FleetAlertSection

MAX_ABSENCE_S = 60.0
"""Seconds after a restart within which an asset that was in alarm must be in the table; then it has recovered."""

MAX_LISTED, MAX_NAMED = 100, 5
"""Assets in the lists of a message, and in its text."""


class AssetInAlarm(BaseModel):
    """One asset in alarm."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    asset: str
    health: str
    cause: str = Field(description="name of the most severe detector in alarm, or empty")


class FleetAlertMessage(AlertMessage):
    """Alert of a rule for the assets of a fleet. Lists have at most 100 assets, the new and the worst first."""

    value: float | None = Field(description="number of assets in alarm")
    assets: tuple[AssetInAlarm, ...] = Field(description="assets in alarm")
    fired: tuple[str, ...] = Field(description="those that are new since the last message")
    recovered: tuple[str, ...] = Field(description="assets that have recovered since the last message")


class FleetRule:
    """Assets of a fleet that are in alarm by one rule; not for several threads at once.

    An asset is in alarm once its health has been bad for `after`, until it has been better for `clear`. It is among
    `fired` of one message and, at its end, among `recovered` of another.
    """

    def __init__(self, rule: FleetAlertSection, fleet: str, link: str | None) -> None:
        """`fleet`: its name; `link`: address of the overview, without the token."""
        self.rule, self._fleet, self._link = rule, fleet, link
        self._level = HEALTH_NAMES.index(rule.health)
        self._begun = self._seen = np.zeros(0)
        self._alarm = np.zeros(0, np.bool_)
        self._told = np.zeros(0, np.bool_)
        """Whether the last message had an asset in alarm."""
        self._sent = -np.inf
        self._since = self._id = ""
        self._names: Sequence[str] = ()
        self._absent: dict[str, None] = {}
        """Assets that the last message before a restart had in alarm, and that are not in the table yet."""
        self._absent_until = -np.inf
        self._removed = False
        """Whether the rule is no longer in the YAML."""

    def evaluate(self, names: Sequence[str], table: FleetTable, now: float) -> FleetAlertMessage | None:
        """Return the message to send now, if any.

        Args:
            names: Names of the assets; only appended to.
            table: Their states.
            now: Monotonic time, s.
        """
        new = names[self._begun.size :]
        # Told before a restart: in alarm until it is certain that they have recovered.
        known = np.array([self._absent.pop(name, 0) is None for name in new], np.bool_)
        self._names = names
        self._begun = np.append(self._begun, np.where(known, -np.inf, np.nan))
        self._seen = np.append(self._seen, np.where(known, now + SETTLE_S, np.nan))
        self._alarm, self._told = (np.append(column, known) for column in (self._alarm, self._told))
        rule, bad = self.rule, (table.health >= self._level) & (not self._removed)
        self._begun[bad & np.isnan(self._begun)] = now
        self._seen[bad] = now
        # After a restart without the state of the assets, nothing is known of those that have not reported.
        unknown = self._alarm & (table.health == WAITING)
        self._seen[unknown] = np.maximum(self._seen[unknown], now + SETTLE_S)
        over = ~bad & (now - self._seen >= rule.clear)
        self._begun[over] = np.nan
        self._alarm = (self._alarm & ~over) | (bad & (now - self._begun >= rule.after))
        fired, recovered = self._alarm & ~self._told, self._told & ~self._alarm
        gone = [*self._absent] if now >= self._absent_until else []
        better = (recovered.any() or gone) and len(gone) == len(self._absent)
        changed, waited = bool(fired.any() or better), now - self._sent
        again = rule.repeat != "never" and self._alarm.any() and waited >= rule.repeat
        if not (again or (changed and waited >= rule.group)):
            return None
        if not (self._told.any() or self._absent):
            self._since = iso_now()
            self._id = hashlib.sha256(f"{self._fleet}|{rule.title}|{self._since}".encode()).hexdigest()[:16]
        self._sent, self._told = now, self._alarm.copy()
        for name in gone:
            del self._absent[name]
        return self._message(names, table, fired, recovered, gone)

    def state(self, now: float) -> JsonObject | None:
        """Return the open alert, for JSON; None if there is none."""
        told = [*(self._names[k] for k in np.flatnonzero(self._told).tolist()), *self._absent]
        if not told:
            return None
        known = {"id": self._id, "since": self._since, "sent": now - self._sent, "assets": told}
        return known | {"rule": self.rule.model_dump(mode="json", exclude_unset=True)}

    def restore(self, state: JsonObject, ago: float, now: float, removed: bool) -> None:
        """Continue with an open alert, before the first look; `ago`: seconds since its `state`."""
        self._id, self._since, self._sent = str(state["id"]), str(state["since"]), now - ago - state["sent"]
        self._absent = dict.fromkeys(map(str, state["assets"]))
        self._absent_until, self._removed = now + MAX_ABSENCE_S, removed

    def _message(
        self, names: Sequence[str], table: FleetTable, fired: np.ndarray, recovered: np.ndarray, gone: Sequence[str]
    ) -> FleetAlertMessage:
        count = int(self._alarm.sum()) + len(self._absent)
        listed = [
            AssetInAlarm(asset=names[k], health=HEALTH_NAMES[table.health[k]], cause=str(table.cause[k]))
            for k in _worst(self._alarm, fired, table)
        ]
        new, better = ([names[k] for k in _worst(mask, mask, table)] for mask in (fired, recovered))
        better = [*better, *gone][:MAX_LISTED]
        leading = listed[0] if listed else None
        guide = self.rule.health if leading is None else leading.cause or leading.health
        first = [
            f"{item.asset} ({', '.join(dict.fromkeys((item.health, item.cause or item.health)))})"
            for item in listed[:MAX_NAMED]
        ]
        if self._removed:
            text = f"the rule {self.rule.title} was removed"
        elif leading is None:
            text = f"no asset is {self.rule.health} or worse any longer"
        else:
            text = f"{counted(count, 'asset')} {self.rule.health} or worse, {int(fired.sum())} new: {', '.join(first)}"
            text += f" and {count - len(first):,} more" if count > len(first) else ""
        if (number := int(recovered.sum()) + len(gone)) and not self._removed:
            text += f"; {counted(number, 'asset')} recovered"
        return FleetAlertMessage(
            twin=self._fleet,
            id=self._id,
            status=FIRING if fired.any() else REPEATED if count else RESOLVED,  # type: ignore[arg-type]
            rule=self.rule.title,
            subject=leading.asset if leading is not None and count == 1 else counted(count, "asset"),
            text=printable(text),
            health=HEALTH_NAMES[table.health[self._alarm].max(initial=TRACKING)],
            since=self._since,
            sent=iso_now(),
            value=float(count),
            unit="assets",
            guide=f"docs/alarms.md#{anchor(guide)}",
            link=self._link,
            response=advice(guide, "Response"),
            assets=tuple(listed),
            fired=tuple(new),
            recovered=tuple(better),
        )


class FleetRules:
    """Rules of a fleet."""

    message = FleetAlertMessage
    """Type of the messages."""

    def __init__(
        self,
        rules: Sequence[FleetAlertSection],
        fleet: str,
        *,
        link: str | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`fleet`: its name; `link`: address of the overview, without the token; `clock` returns seconds."""
        self._make, self._clock = partial(FleetRule, fleet=fleet, link=link), clock
        self._rules = dict(zip(numbered([rule.title for rule in rules]), map(self._make, rules), strict=True))

    def evaluate(self, names: Sequence[str], table: FleetTable) -> list[tuple[FleetAlertSection, FleetAlertMessage]]:
        """Return the messages to send now, each with its rule."""
        now = self._clock()
        found = [(item.rule, item.evaluate(names, table, now)) for item in self._rules.values()]
        return [(rule, message) for rule, message in found if message is not None]

    def state(self) -> list[tuple[object, JsonObject]]:
        """Return the open alerts, for JSON."""
        now = self._clock()
        states = [(key, rule.state(now)) for key, rule in self._rules.items()]
        return [(key, state) for key, state in states if state is not None]

    def restore(self, state: Sequence[tuple[Sequence[str], JsonObject]], ago: float) -> None:
        """Continue with open alerts as `AlertRules.restore` does, before the first look."""
        now = self._clock()
        for key, item in state:
            name = str(key[0]), str(key[1])
            removed = name not in self._rules
            rule = self._make(FleetAlertSection.model_validate(item["rule"])) if removed else self._rules[name]
            rule.restore(item, ago, now, removed)
            self._rules[name] = rule


def _worst(mask: np.ndarray, new: np.ndarray, table: FleetTable) -> list[int]:
    """Return the positions of a mask, the new ones and then the worst health first, at most `MAX_LISTED`."""
    places = np.flatnonzero(mask)
    order = np.lexsort((-table.health[places].astype(int), ~new[places]))  # stable
    found: list[int] = places[order][:MAX_LISTED].tolist()
    return found
