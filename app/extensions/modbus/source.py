"""Source of the registers of a Modbus TCP device, which are asked for again and again."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

from app.twin.sources.kind import Opening, failure
from app.twin.sources.push import messages_of
from estimators.errors import ConfigError, printable
from sources.messages import NO_BROKER, REFUSED, REFUSED_MESSAGE, RETRY_S, Messages
from sources.source import Report, Source

from .schema import BIT_TABLES, ModbusSourceSection, RegisterSection

NO_REGISTER = "no register"  # Key of registers that the device does not give
ANSWER_TIMEOUT_S = 1.0

MAX_REGISTERS = 65_536
"""Registers of a table of a Modbus device."""

MAX_COUNT = {"holding": 125, "input": 125, "coil": 2000, "discrete": 2000}
"""Most registers or bits of a request, by table (Modbus Application Protocol 1.1b3, sections 6.1 to 6.4)."""


class Block(NamedTuple):
    """Registers of a table that one request reads: those from `first` on, below `end`."""

    table: str
    first: int
    end: int
    names: tuple[str, ...]


def blocks_of(registers: Mapping[str, RegisterSection]) -> list[Block]:
    """Return the requests: values that are adjacent are read together, so that they are of one moment."""
    found: list[Block] = []
    for name, item in sorted(registers.items(), key=lambda pair: (pair[1].table, pair[1].address)):
        end, last = item.address + item.size, found[-1] if found else None
        joins = last is not None and last.table == item.table and item.address <= last.end
        if last is not None and joins and end - last.first <= MAX_COUNT[item.table]:
            found[-1] = last._replace(end=max(last.end, end), names=(*last.names, name))
        else:
            found.append(Block(item.table, item.address, end, (name,)))
    return found


class ModbusSource:
    """Live source of the registers of a device. What the device does not give is missing."""

    live = utc = True

    def __init__(self, messages: Messages, section: ModbusSourceSection, report: Report) -> None:
        """Connect in a thread of its own; a device that is not there is waited for.

        Args:
            messages: Takes the values.
            section: The device and its registers.
            report: Receives lost connections and refused registers.

        Raises:
            ConfigError: If pymodbus is not installed.
        """
        try:
            from pymodbus.client import ModbusTcpClient
        except ModuleNotFoundError:
            raise ConfigError("Modbus needs pymodbus: pip install 'nisus[modbus]'") from None
        logging.getLogger("pymodbus").addHandler(logging.NullHandler())  # what it logs is reported here, in one line
        self._messages, self._section, self._report = messages, section, report
        self.read, self.now = messages.read, messages.now
        self._place = f"{section.host}:{section.port}"
        self._client: Any = ModbusTcpClient(section.host, port=section.port, timeout=ANSWER_TIMEOUT_S, retries=0)
        self._ask = {
            "holding": self._client.read_holding_registers,
            "input": self._client.read_input_registers,
            "coil": self._client.read_coils,
            "discrete": self._client.read_discrete_inputs,
        }
        self._blocks = blocks_of(section.registers)
        self.connected = threading.Event()
        """Set while the device answers."""
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="Modbus source", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        """Read until the source is closed; connect again after a failure."""
        while not self._stopping.is_set():
            try:
                if not self._client.connect():
                    raise ConnectionError("it does not answer")
                self._poll()
            except Exception as error:  # noqa: BLE001  no device may end the source
                why = printable(str(error) or type(error).__name__)
                self._report(NO_BROKER, f"no measurements from the device at {self._place}: {why}; it is tried again")
            self.connected.clear()
            self._client.close()
            self._stopping.wait(RETRY_S)

    def _poll(self) -> None:
        """Read all blocks each period; their values count at the moment of the last answer."""
        due = time.monotonic()
        while not self._stopping.wait(max(0.0, due - time.monotonic())):
            values: dict[str, float | None] = {}
            for block in self._blocks:
                values |= self._read(block)
            # One message: a vector of several blocks stays one measurement.
            answer = self._messages.send([{"source": f"modbus {self._place}", "values": values}])[0]
            if answer.status == REFUSED:
                self._report(REFUSED_MESSAGE, f"registers of {self._place}: {answer.reason}; they are not used")
            self.connected.set()
            # A device that is slower than the period is read without pause, but not several times in a row.
            due = max(due + self._section.every, time.monotonic())

    def _read(self, block: Block) -> dict[str, float | None]:
        answer = self._ask[block.table](block.first, count=block.end - block.first, device_id=self._section.device)
        if not answer.isError():
            return {name: self._value(self._section.registers[name], block, answer) for name in block.names}
        where = f"{block.table} {block.first} to {block.end - 1}"
        text = f"the device at {self._place} does not give {', '.join(block.names)} ({where}): {answer}"
        self._report(NO_REGISTER, f"{printable(text)}; check address, table and device")
        return dict.fromkeys(block.names)

    def _value(self, item: RegisterSection, block: Block, answer: Any) -> float:
        at = item.address - block.first
        if item.table in BIT_TABLES:
            return float(answer.bits[at])
        kind = self._client.DATATYPE[item.type.upper()]
        words = answer.registers[at : at + item.size]
        return float(self._client.convert_from_registers(words, kind, word_order=item.words))

    def close(self) -> None:
        """Disconnect."""
        self._stopping.set()
        self._client.close()
        self._thread.join(2.0 * ANSWER_TIMEOUT_S)


def open_modbus(opening: Opening) -> Source:
    """Open the source of a section.

    Raises:
        SourceError: If a register or a value does not exist.
    """
    section: ModbusSourceSection = opening.section
    messages = messages_of(opening, "registers", section.registers)
    for name, item in section.registers.items():
        last = MAX_REGISTERS - item.size
        if item.address > last:
            text = f"is {item.address}; a {item.type} has {item.size} registers, so it is at most {last}"
            raise failure(opening.loaded, (*opening.key, "registers", name, "address"), text)
    return ModbusSource(messages, section, opening.report)
