"""Registers of a Modbus TCP device: numbers of all types, blocks, refused registers, and a device that comes back."""

import struct
from contextlib import closing

import numpy as np
import pytest

from app.extensions.modbus.schema import ModbusSourceSection
from app.extensions.modbus.source import ModbusSource, blocks_of
from estimators.log import READING
from sources.messages import Messages
from sources.source import Channel
from tests.extensions.modbus.device import Device
from tests.waiting import wait_for

FORMATS = dict(int16="h", uint16="H", int32="i", uint32="I", int64="q", uint64="Q", float32="f", float64="d")


@pytest.fixture
def device():
    made = Device()
    yield made
    made.stop()


def source(served, registers, report=lambda key, text: None, **given):
    channels = [Channel(READING, k, name, (name,), model_units=("1",)) for k, name in enumerate(registers)]
    given |= {"type": "modbus", "host": "127.0.0.1", "port": served.port, "every": 0.01, "registers": registers}
    return closing(ModbusSource(Messages(channels, width=1), ModbusSourceSection(**given), report))


def values(reader, want=1):
    """The last value of each sensor, once `want` of them are known."""
    last = {}

    def heard():
        events = reader.read(0.1)
        last.update(zip(events.channel.tolist(), events.value[:, 0].tolist(), strict=True))
        return len(last) >= want

    wait_for(heard)
    return last


@pytest.mark.parametrize("words", ["big", "little"])
@pytest.mark.parametrize(("kind", "code"), FORMATS.items())
def test_a_number_is_what_the_device_packed(device, kind, code, words):
    value = -12.5 if kind.startswith("float") else 200 if kind.startswith("u") else -200
    data = struct.pack(f">{code}", value)
    if words == "little":  # the registers in reverse, each with its high byte first
        data = b"".join(data[k : k + 2] for k in range(len(data) - 2, -1, -2))
    device.give(7, data, "input")
    with source(device, {"a": {"address": 7, "table": "input", "type": kind, "words": words}}, device=9) as reader:
        assert values(reader) == {0: value}
        assert device.requests[0] == (9, 4, 7, len(data) // 2)


def test_bits_are_zero_and_one(device):
    device.tables["coil"] = {k: int(k in (3, 11)) for k in range(16)}
    device.tables["discrete"] = {5: 1}
    registers = {name: {"address": k, "table": "coil"} for name, k in (("off", 2), ("on", 3), ("far", 11))}
    with source(device, registers | {"other": {"address": 5, "table": "discrete"}}) as reader:
        assert values(reader, 4) == {0: 0.0, 1: 1.0, 2: 1.0, 3: 1.0}


def test_adjacent_registers_are_one_request_of_at_most_125():
    registers = {f"r{k}": k for k in range(200)} | {"apart": {"address": 300, "type": "float64"}}
    # Two views of the same registers overlap; other tables are other requests.
    registers |= {"whole": {"address": 400, "type": "float64"}, "part": 401, "bit": {"address": 401, "table": "coil"}}
    bits, *found = blocks_of(ModbusSourceSection(type="modbus", host="device", registers=registers).registers)
    assert bits == ("coil", 401, 402, ("bit",)) and {block.table for block in found} == {"holding"}
    assert [(block.first, block.end) for block in found] == [(0, 125), (125, 200), (300, 304), (400, 404)]
    assert found[-1].names == ("whole", "part")


def test_what_the_device_refuses_is_missing_and_told(device):
    told = []
    device.give(1, struct.pack(">H", 42))
    registers = {"there": 1, "not there": 50}
    with source(device, registers, lambda *line: told.append(line)) as reader:
        found = values(reader, 2)
        assert found[0] == 42.0 and np.isnan(found[1])
        key, text = told[0]
        assert key == "no register" and text.startswith(
            f"the device at 127.0.0.1:{device.port} does not give not there (holding 50 to 50): "
        )
        assert text.endswith("; check address, table and device") and "\n" not in text


def test_a_device_that_goes_and_comes_back_is_read_again(device):
    told = []
    device.give(1, struct.pack(">H", 1))
    with source(device, {"a": 1}, lambda *line: told.append(line)) as reader:
        assert values(reader) == {0: 1.0}
        device.stop()
        wait_for(lambda: told)
        assert told[0][0] == "no broker"
        assert told[0][1].startswith(f"no measurements from the device at 127.0.0.1:{device.port}: ")
        while len(reader.read(0.0)):
            pass
        again = Device(device.port)
        again.give(1, struct.pack(">H", 2))
        assert values(reader) == {0: 2.0}
    again.stop()
