"""Sparkplug B 3.0: a twin as an edge node with a birth, a death and numbered data in protobuf.

Source: Eclipse Sparkplug 3.0.0 (2022), chapters 4 to 6: topics, operation, payloads.
"""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from estimators.diagnostics.references import withheld
from estimators.errors import ConfigError

from ..live.outputs import Cursor
from ..present.state_message import PUBLISHED, StateMessage, state_message

if TYPE_CHECKING:
    from ..live.running_fold import Running

INT32, INT64, DOUBLE, BOOLEAN, STRING = 3, 4, 10, 11, 12
"""Data types of metrics and properties."""

VALUE_FIELDS = {INT64: 11, DOUBLE: 13, BOOLEAN: 14, STRING: 15}
"""Field of a metric that holds its value."""

BAD, GOOD, STALE = 0, 192, 500
"""The only values of the property Quality."""

SEQUENCE = 256
"""Numbers of messages and of connections count from 0 to 255."""

BDSEQ, REBIRTH = "bdSeq", "Node Control/Rebirth"

MAX_HISTORY = 200
"""Published states whose new estimates are sent after a refold."""


class Packet(NamedTuple):
    """A message to the broker."""

    topic: str
    payload: str | bytes
    qos: int = 0
    retain: bool = False


class Metric(NamedTuple):
    """Value of one metric, None if it has none, with its quality and unit."""

    name: str
    datatype: int
    value: float | str | bool | None
    quality: int = GOOD
    unit: str = ""


class SparkplugNode:
    """Messages of one twin as edge node `twin` of a group; see `mqtt.JsonTopics`."""

    def __init__(self, group: str, engine: Running) -> None:
        """Name the node.

        Raises:
            ConfigError: If the twin's name cannot be part of a topic.
        """
        name = engine.twin.name
        if any(c in name for c in "+/#"):
            raise ConfigError(
                f"outputs.mqtt.sparkplug: the twin's name {name!r} has one of + / #, which the name of a node may not "
                "have; rename the twin's file"
            )
        self._engine, self._group, self._node = engine, group, name
        self._connection, self._seq, self._revision = 0, 0, -1
        self._born = self._used = False
        """Whether this connection has had a birth since it began; whether the number has."""
        self._units: tuple[tuple[str, str], ...] = ()
        self._sent: dict[str, Metric] = {}
        self._times: deque[int] = deque(maxlen=MAX_HISTORY)
        self.place = f"{group}/{name}"
        self.commands: str | None = self._topic("NCMD")
        """Topic of commands to this node."""

    def _topic(self, kind: str) -> str:
        return f"spBv1.0/{self._group}/{kind}/{self._node}"

    def will(self) -> Packet:
        """Return the death of the next connection, which has a number of its own."""
        if self._used:
            self._connection, self._used = (self._connection + 1) % SEQUENCE, False
        return self.death()

    def death(self) -> Packet:
        """Return the death of this connection: all metrics are stale from there on."""
        now = _now_ms()
        metric = _metric(self._bdseq(), now, named=True)
        return Packet(self._topic("NDEATH"), _field(1, now) + _field(2, metric), qos=1)

    def births(self, message: StateMessage | None = None) -> list[Packet]:
        """Return the birth, with names, types, units and present values of all metrics."""
        message = message or state_message(self._engine)
        metrics, t = metrics_of(message), _time_ms(message)
        self._born = self._used = True
        self._seq, self._revision = 0, message.revision
        self._units = tuple((item.name, item.unit) for item in metrics)
        self._sent = {item.name: item for item in metrics}
        self._note(message)
        fixed = [_metric(item, t, named=True) for item in (self._bdseq(), Metric(REBIRTH, BOOLEAN, False))]
        named = [_metric(item, t, alias=k, named=True) for k, item in enumerate(metrics, start=1)]
        return [Packet(self._topic("NBIRTH"), self._payload([*fixed, *named]))]

    def states(self, message: StateMessage) -> list[Packet]:
        """Return the metrics that changed; after a refold also the new estimates of earlier states."""
        if not self._born:
            return []
        metrics, t = metrics_of(message), _time_ms(message)
        if tuple((item.name, item.unit) for item in metrics) != self._units:
            return self.births(message)  # The model was saved with other states
        changed = [
            _metric(item, t, alias=k)
            for k, item in enumerate(metrics, start=1)
            if item != self._sent[item.name]
        ]  # fmt: skip
        self._sent = {item.name: item for item in metrics}
        packets = [self._data(changed)] if changed else []
        if message.revision != self._revision:
            self._revision = message.revision
            history = self._history(message)
            packets += [self._data(history)] if history else []
        self._note(message)
        return packets

    def lost(self) -> None:
        """Note the end of a connection: a birth comes before further data."""
        self._born = False

    def wants_birth(self, payload: bytes) -> bool:
        """Return whether a command requests a birth.

        Raises:
            ValueError: If it is no payload of Sparkplug, or another command.
        """
        metrics = [dict(_fields(body)) for number, body in _fields(payload) if number == 2 and isinstance(body, bytes)]
        for metric in metrics:
            if metric.get(1) == REBIRTH.encode():
                return bool(metric.get(VALUE_FIELDS[BOOLEAN]))
        raise ValueError(f"it is not {REBIRTH}")

    def _bdseq(self) -> Metric:
        return Metric(BDSEQ, INT64, self._connection)

    def _note(self, message: StateMessage) -> None:
        if message.time is not None and message.time_ns is not None and message.time_ns not in self._times:
            self._times.append(message.time_ns)

    def _data(self, metrics: list[bytes]) -> Packet:
        self._seq = (self._seq + 1) % SEQUENCE
        return Packet(self._topic("NDATA"), self._payload(metrics))

    def _payload(self, metrics: list[bytes]) -> bytes:
        return _field(1, _now_ms()) + b"".join(_field(2, item) for item in metrics) + _field(3, self._seq)

    def _history(self, message: StateMessage) -> list[bytes]:
        """Return the estimates of the shown revision at the times of earlier states, marked as historical."""
        last = message.time_ns
        times = [t for t in self._times if last is not None and t < last]
        if last is None or not times:
            return []
        rows = self._engine.pull(Cursor(span=last - min(times)))
        model, found = self._engine.model, []
        usable = np.isin(rows.track.health, PUBLISHED)[:, None] & ~withheld(model, rows.track)
        usable &= np.isfinite(rows.track.mean) & np.isfinite(rows.track.std)
        aliases = {name: k for k, (name, _) in enumerate(self._units, start=1)}
        for t in times:
            i = int(np.searchsorted(rows.events.t, t, "right")) - 1
            if i < 0 or rows.events.t[i] != t:
                continue  # Dropped, or of an earlier log
            for j, state in enumerate(model.shown_states):
                for name, column in ((state_name(state.name), rows.track.mean), (std_name(state.name), rows.track.std)):
                    good = bool(usable[i, j])
                    item = Metric(name, DOUBLE, float(column[i, j]) if good else None, GOOD if good else BAD)
                    found.append(_metric(item, t // 10**6, alias=aliases[name], historical=True))
        return found


def state_name(name: str) -> str:
    """Return the name of the metric of a state's mean."""
    return f"state/{name}"


def std_name(name: str) -> str:
    """Return the name of the metric of a state's standard deviation."""
    return f"state/{name}/std"


def metrics_of(message: StateMessage) -> list[Metric]:
    """Return the metrics of a state message, in an order that depends on the model alone."""
    found = []
    for state in message.states:
        quality = GOOD if state.valid else STALE if message.health == "stale" else BAD
        found.append(Metric(state_name(state.name), DOUBLE, state.value, quality, state.unit))
        found.append(Metric(std_name(state.name), DOUBLE, state.std, quality, state.unit))
    found.append(Metric("health", STRING, message.health))
    found.append(Metric("cause", STRING, message.cause))
    return [*found, Metric("revision", INT64, message.revision)]


def _now_ms() -> int:
    return time.time_ns() // 10**6


def _time_ms(message: StateMessage) -> int:
    """Return the time of the state, ms since 1970; that of sending if the clock of its source is no calendar."""
    return _now_ms() if message.time is None or message.time_ns is None else message.time_ns // 10**6


# Protobuf, by hand: of its messages these few fields are needed, which takes less code than a compiled description and
# the package that reads it.


def _varint(number: int) -> bytes:
    found = bytearray()
    while number > 0x7F:
        found.append(number & 0x7F | 0x80)
        number >>= 7
    found.append(number)
    return bytes(found)


def _field(number: int, value: bool | int | float | str | bytes) -> bytes:
    """Return one field: integers as varint, floats as double, text and bytes with their length."""
    if isinstance(value, float):
        return _varint(number << 3 | 1) + struct.pack("<d", value)
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    body = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(body)) + body


def _metric(item: Metric, t: int, *, alias: int = 0, named: bool = False, historical: bool = False) -> bytes:
    """Return a metric of the time `t`, ms: by name, type and unit in a birth, else by alias alone."""
    parts = [_field(1, item.name)] if named else []
    parts += [_field(2, alias)] if alias else []
    parts.append(_field(3, t))
    parts += [_field(4, item.datatype)] if named else []
    parts += [_field(5, True)] if historical else []
    parts += [_field(7, True)] if item.value is None else []
    if alias:
        keys, values = [_field(1, "Quality")], [_field(2, _field(1, INT32) + _field(3, item.quality))]
        if named and item.unit:
            keys.append(_field(1, "engUnit"))
            values.append(_field(2, _field(1, STRING) + _field(8, item.unit)))
        parts.append(_field(9, b"".join([*keys, *values])))
    parts += [_field(VALUE_FIELDS[item.datatype], item.value)] if item.value is not None else []
    return b"".join(parts)


def _fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Yield number and value of each field of a message.

    Raises:
        ValueError: If it is no message of protobuf.
    """
    sizes, at = {1: 8, 5: 4}, 0

    def varint() -> int:
        nonlocal at
        number = 0
        for shift in range(0, 70, 7):
            if at >= len(data):
                break
            byte = data[at]
            at += 1
            number |= (byte & 0x7F) << shift
            if byte < 0x80:
                return number
        raise ValueError("it is no payload of Sparkplug B")

    while at < len(data):
        tag = varint()
        kind = tag & 7
        if kind == 0:
            yield tag >> 3, varint()
            continue
        size = varint() if kind == 2 else sizes.get(kind, len(data) + 1)
        if at + size > len(data):
            raise ValueError("it is no payload of Sparkplug B")
        yield tag >> 3, data[at : at + size]
        at += size
