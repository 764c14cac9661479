"""A small DBC, channels on it, and helpers that the tests of the sources share."""

from collections import Counter
from pathlib import Path
from typing import Any

import can

from estimators.log import READING, Events
from sources.can.decoder import Decoder
from sources.source import Channel
from sources.units import second_ns

DBC = Path(__file__).with_name("plant.dbc").read_text()


class Reports:
    """Keeps what was reported."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.texts: dict[str, str] = {}

    def __call__(self, key: str, text: str) -> None:
        self.counts[key] += 1
        self.texts[key] = text


def dbc(folder: Path, text: str = DBC, name: str = "test.dbc") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def decoding(folder: Path, channels: list[Channel], width: int = 1, **more: Any) -> Decoder:
    """A decoder of channels of the small DBC."""
    return Decoder([(dbc(folder), None)], channels, width=width, **more)


def decoded(decoder: Decoder, messages: list[can.Message]) -> Events:
    """The events of messages that came at their own times."""
    return decoder.decode(decoder.gather(messages, [second_ns(message.timestamp) for message in messages]))


def sensor(index: int, message: str, *signals: str, **more: Any) -> Channel:
    return Channel(READING, index, f"sensor{index}", signals, message, **more)


def frame(identifier: int, data: bytes, *, t: float = 1.0, bus: Any = None, extended: bool = False) -> can.Message:
    return can.Message(timestamp=t, arbitration_id=identifier, is_extended_id=extended, data=data, channel=bus)


def same(a: Events, b: Events) -> bool:
    return all(
        x.shape == y.shape and x.dtype == y.dtype and bool(((x == y) | ((x != x) & (y != y))).all())
        for x, y in zip(a, b, strict=True)
    )
