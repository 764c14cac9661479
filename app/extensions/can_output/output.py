"""CAN: the estimate as a virtual sensor on a bus, in frames that a DBC describes, which Nisus writes.

Each state has two frames of eight bytes: its mean and its standard deviation, as float32. Both carry validity, grade,
age, a counter, and a checksum over identifier and content.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import TYPE_CHECKING

from app.engine.copies import OutputLink
from app.engine.outputs.state_message import StateMessage
from app.engine.running_fold import Running
from app.twin.secrets import Secrets
from app.twin.sources.kind import find_databases
from config.source_schema import CanLogSection, CanSection
from estimators.diagnostics.references import WITHHELD
from estimators.errors import ConfigError, printable
from estimators.track import HEALTH_NAMES

from .schema import CanOutputSection

if TYPE_CHECKING:
    from can import BusABC

FRAME = struct.Struct("<fBBB")
"""Value; counter (low four bits) and grade; validity; age in steps of 10 ms, 255 for 2.55 s and more."""

VERSION = "Nisus"
WRITTEN = f'VERSION "{VERSION}"'
"""Beginning of a DBC that Nisus wrote, and may write again."""

GRADES = (*HEALTH_NAMES, WITHHELD)
LARGEST = 3.4e38  # of a float32
COUNTERS = 16
MEAN, STD = "mean", "std"


def checksum(identifier: int, content: bytes) -> int:
    """Return the CRC-8 SAE J1850 of an identifier (four bytes, little-endian) and the first bytes of its frame."""
    crc = 0xFF
    for byte in identifier.to_bytes(4, "little") + content:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1) ^ 0x1D if crc & 0x80 else crc << 1
            crc &= 0xFF
    return crc ^ 0xFF


class CanOutput:
    """Sends the frames of each state; a bus that does not take them is reported, and the frames are dropped."""

    name = "can"

    def __init__(self, section: CanOutputSection, engine: Running, _secrets: Secrets) -> None:
        """Prepare and write the DBC; the bus is not open yet.

        Raises:
            ConfigError: If an identifier is one of the source's databases, or the DBC cannot be written.
        """
        self._section, self._engine = section, engine
        self._names = [state.name for state in engine.model.shown_states]
        last = section.id + 2 * len(self._names) - 1
        limit = 0x1FFFFFFF if section.extended else 0x7FF
        if last > limit:
            raise ConfigError(
                f"outputs.can: {len(self._names)} states need the identifiers {section.id:#x} to {last:#x}; the "
                f"largest is {limit:#x}: give a smaller id, or extended: true"
            )
        taken = listened(engine)
        for identifier in range(section.id, last + 1):
            if identifier in taken:
                raise ConfigError(
                    f"outputs.can: identifier {identifier:#x} is {taken[identifier]} of the source's database; "
                    f"give another id, of which {2 * len(self._names)} from there on are free"
                )
        self._write(engine.twin.path.absolute().parent / section.dbc)
        self._bus: BusABC | None = None
        self._counter = 0
        self._problem = "not open yet"

    def _write(self, path: Path) -> None:
        try:
            if path.exists() and not path.read_text(encoding="utf-8", errors="replace").startswith(WRITTEN):
                raise ConfigError(
                    f"outputs.can.dbc: {path} is not written by Nisus, and is kept; choose another path, or move it"
                )
            path.write_text(dbc_text(self._section, self._engine), encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"outputs.can.dbc: {path} cannot be written ({error.strerror}); check the path") from None

    def start(self) -> None:
        """See `Output`."""
        self._open()

    def _open(self) -> None:
        import can

        section = self._section
        try:
            self._bus = can.Bus(interface=section.interface, channel=section.channel, **section.options)
            self._problem = ""
        except Exception as error:  # noqa: BLE001  each interface raises errors of its own
            self._failed(error)

    def _failed(self, error: Exception) -> None:
        problem = printable(str(error) or type(error).__name__)
        if problem != self._problem:
            place = f"{self._section.interface} {self._section.channel}"
            text = f"output can: {place} does not take frames ({problem}); it is tried again"
            self._engine.notices.say(text, level="warn")
            self._engine.notices.count("output can")
        self._problem = problem

    def publish(self, message: StateMessage) -> None:
        """See `Output`."""
        import can

        if self._bus is None:
            self._open()
        if self._bus is None:
            return
        try:
            for identifier, content in frames(self._section.id, message, self._counter):
                frame = can.Message(
                    arbitration_id=identifier, data=content, is_extended_id=self._section.extended, check=False
                )
                self._bus.send(frame, timeout=None)
        except Exception as error:  # noqa: BLE001  as above; also a full queue of the driver
            self._failed(error)
        else:
            self._problem = ""
        self._counter = (self._counter + 1) % COUNTERS

    def stop(self) -> None:
        """See `Output`."""
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.shutdown()

    def link(self) -> OutputLink:
        """See `Output`."""
        place = f"{self._section.interface} {self._section.channel}, from {self._section.id:#x}"
        return OutputLink(self._bus is not None and not self._problem, self._problem or place)


def listened(engine: Running) -> dict[int, str]:
    """Return the messages of the source's databases by their identifier."""
    import cantools

    section = engine.twin.config.source
    if not isinstance(section, CanSection | CanLogSection):
        return {}
    found: dict[int, str] = {}
    for path, _ in find_databases(engine.twin.loaded, section, ("source",)):
        database = cantools.database.load_file(path, strict=False)
        found |= {message.frame_id: message.name for message in database.messages}
    return found


def frames(first: int, message: StateMessage, counter: int) -> list[tuple[int, bytes]]:
    """Return identifier and content of the frames of a state message. Values that are not valid are 0."""
    age = min(255, int((message.age_s or 0.0) * 100.0))
    found = []
    for k, state in enumerate(message.states):
        head = counter | GRADES.index(state.grade) << 4
        for offset, value in enumerate((state.value, state.std)):
            identifier, valid = first + 2 * k + offset, value is not None and abs(value) <= LARGEST
            content = FRAME.pack(value if valid else 0.0, head, valid, age)
            found.append((identifier, content + bytes([checksum(identifier, content)])))
    return found


def dbc_text(section: CanOutputSection, engine: Running) -> str:
    """Return a DBC of the frames of a twin."""
    from cantools.database import Database, Message, Signal
    from cantools.database.conversion import BaseConversion

    # Names in a DBC are those of C.
    name = re.sub(r"[^A-Za-z0-9_]|^(?=[0-9])", "_", engine.twin.name)
    words = dict(enumerate(GRADES))
    messages = []
    for k, state in enumerate(engine.model.shown_states):
        for offset, part in enumerate((MEAN, STD)):
            own = f"{state.name}_{part}"
            value = BaseConversion.factory(1, 0, is_float=True)
            signals = [
                Signal(own, 0, 32, conversion=value, unit=state.unit),
                Signal(f"{own}_counter", 32, 4),
                Signal(f"{own}_grade", 36, 4, conversion=BaseConversion.factory(1, 0, choices=words)),
                Signal(f"{own}_valid", 40, 1),
                Signal(f"{own}_age", 48, 8, conversion=BaseConversion.factory(0.01, 0), unit="s"),
                Signal(f"{own}_checksum", 56, 8),
            ]
            identifier = section.id + 2 * k + offset
            messages.append(Message(identifier, f"{name}_{own}", 8, signals, is_extended_frame=section.extended))
    return str(Database(messages, version=VERSION).as_dbc_string())
