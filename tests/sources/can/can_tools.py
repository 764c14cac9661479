"""A small DBC, channels on it, and helpers that the tests of the sources share."""

from collections import Counter
from pathlib import Path
from typing import Any

import can

from estimators.log import READING, Events
from sources.can.decoder import Decoder
from sources.source import Channel

DBC = """VERSION ""

NS_ :

BS_:

BU_: ECU TWIN

BO_ 256 ENGINE: 8 ECU
 SG_ Temp : 0|16@1+ (0.1,-40) [0|0] "degC" TWIN
 SG_ Rpm : 23|16@0+ (0.25,0) [0|0] "rpm" TWIN
 SG_ Torque : 32|12@1- (0.5,0) [0|0] "Nm" TWIN
 SG_ Ok : 63|1@1+ (1,0) [0|1] "" TWIN

BO_ 2147484160 WIDE: 8 ECU
 SG_ Ratio : 0|64@1- (1,0) [0|0] "" TWIN

BO_ 258 FIX: 8 ECU
 SG_ Lat : 0|32@1- (1e-07,0) [0|0] "deg" TWIN
 SG_ Lon : 32|32@1- (1e-07,0) [0|0] "deg" TWIN

BO_ 259 MUX: 8 ECU
 SG_ Service M : 0|8@1+ (1,0) [0|0] "" TWIN
 SG_ Pid m1M : 8|8@1+ (1,0) [0|0] "" TWIN
 SG_ Speed m13 : 16|8@1+ (1,0) [0|0] "km/h" TWIN
 SG_ Revs m12 : 23|16@0+ (0.25,0) [0|0] "rpm" TWIN
 SG_ Code m3 : 8|16@1+ (1,0) [0|0] "" TWIN

SIG_VALTYPE_ 2147484160 Ratio : 2;
SG_MUL_VAL_ 259 Pid Service 1-1;
SG_MUL_VAL_ 259 Speed Pid 13-13;
SG_MUL_VAL_ 259 Revs Pid 12-12, 28-30;
SG_MUL_VAL_ 259 Code Service 3-4;
"""


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


def sensor(index: int, message: str, *signals: str, **more: Any) -> Channel:
    return Channel(READING, index, f"sensor{index}", signals, message, **more)


def frame(identifier: int, data: bytes, *, t: float = 1.0, bus: Any = None, extended: bool = False) -> can.Message:
    return can.Message(timestamp=t, arbitration_id=identifier, is_extended_id=extended, data=data, channel=bus)


def same(a: Events, b: Events) -> bool:
    return all(
        x.shape == y.shape and x.dtype == y.dtype and bool(((x == y) | ((x != x) & (y != y))).all())
        for x, y in zip(a, b, strict=True)
    )
