"""One measurement from any live source: the same state from every output, equal to the row of the fold."""

import json
import socket
import struct
import uuid
from datetime import UTC, datetime, timedelta

import can
import cantools
import numpy as np
import pytest
from asyncua import ua
from asyncua.sync import Client, Server

from app.engine.outputs.publisher import Publisher
from app.extensions.can_output.output import checksum, frames
from app.extensions.opcua.output import STATUS_CODES, values_of
from app.twin.twin import load_twin
from estimators import fold
from estimators.errors import ConfigError, NisusError
from estimators.log import READING, Log
from sources.source import ignore
from tests import ROOT
from tests.app.engine.outputs.pushed import BEGIN, publishing, push, pushed_twin
from tests.app.engine.outputs.test_alerts import state
from tests.app.scripted import notice_texts, pull_all
from tests.cases import cases
from tests.extensions.modbus.device import Device
from tests.extensions.mqtt.broker import Listener
from tests.extensions.mqtt.conftest import broker, listener
from tests.support import SECOND, error_of, free_port
from tests.waiting import wait_for

__all__ = ["broker", "listener"]

VALUES = (40.25, 41.5, 42.125, 41.75)
"""Exact in float32, so that a frame of the bus carries them."""

DBC = """VERSION ""
BU_: Nisus
BO_ 256 Plant: 8 Nisus
 SG_ winding : 0|32@1- (1,0) [0|0] "degC" Nisus
SIG_VALTYPE_ 256 winding : 1;
"""


class Plant:
    """The measurements of one kind of source."""

    def __init__(self, folder, broker):
        self.folder, self.broker = folder, broker
        self.channel = f"test {uuid.uuid4().hex}"
        (folder / "plant.dbc").write_text(DBC)
        self.closing = []

    def post(self, page):
        push(page, *enumerate(VALUES))

    def source(self, kind):
        if kind == "mqtt":
            topics = {"plant/t": {"values": {"winding": "v"}, "time": "t", "unit": "s"}}
            return {"type": kind, "host": "127.0.0.1", "port": self.broker.port, "topics": topics}
        if kind == "opcua":
            self.server, url = Server(), f"opc.tcp://127.0.0.1:{free_port()}"
            self.server.set_endpoint(url)
            index = self.server.register_namespace("plant")
            node = ua.NodeId("winding", index)
            self.node = self.server.nodes.objects.add_variable(node, "winding", 0.0)
            self.write(-1, 0.0, ua.StatusCodes.Bad)
            self.server.start()
            self.closing.append(self.server.stop)
            return {"type": kind, "url": url, "nodes": {"winding": f"ns=0{index};s=winding"}, "every": 0.01}
        if kind == "modbus":
            self.device = Device()
            self.closing.append(self.device.stop)
            registers = {"winding": {"address": 100, "type": "float32"}}
            return {"type": kind, "host": "127.0.0.1", "port": self.device.port, "every": 0.01, "registers": registers}
        if kind == "can":
            sensors = {"winding": {"message": "Plant", "signals": "winding"}}
            bus = {"interface": "virtual", "channel": self.channel, "dbc": str(self.folder / "plant.dbc")}
            return {"type": kind, **bus, "sensors": sensors}
        return {"type": kind}

    def write(self, k, value, status=ua.StatusCodes.Good):
        stamp = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=k)
        self.node.write_value(ua.DataValue(ua.Variant(value), ua.StatusCode(status), SourceTimestamp=stamp))

    def send(self, kind, page):
        if kind == "push":
            self.post(page)
        elif kind == "mqtt":
            wait_for(page.engine.source.inner.connected.is_set)
            sender = Listener(self.broker)
            for k, value in enumerate(VALUES):
                sender.publish("plant/t", {"v": value, "t": BEGIN // SECOND + k})
            sender.stop()
        elif kind == "opcua":
            wait_for(page.engine.source.inner.connected.is_set)
            for k, value in enumerate(VALUES):
                # Between two publications a server keeps the last value only.
                wait_for(lambda k=k: len(finite_rows(page)[1]) >= k)
                self.write(k, value)
        elif kind == "modbus":
            for value in VALUES:
                self.device.give(100, struct.pack(">f", value))
                wait_for(lambda value=value: value in finite_values(page))
            self.device.stop()
            source = page.engine.source.inner
            wait_for(lambda: not source.connected.is_set())
            # An answer may have been on its way; the first ones, before there was a value, had none.
            wait_for(lambda: np.sum(pull_all(page.engine).events.kind == READING) == source._messages.accepted)
        else:
            bus = can.Bus(interface="virtual", channel=self.channel)
            for k, value in enumerate(VALUES):
                bus.send(can.Message(arbitration_id=256, data=struct.pack("<fI", value, 0), is_extended_id=False))
                wait_for(lambda k=k: len(finite_rows(page)[1]) > k)
            bus.shutdown()

    def close(self):
        for close in self.closing:
            close()


def finite_rows(page):
    """All rows, and the indices of those with a measurement."""
    rows = pull_all(page.engine)
    return rows, np.flatnonzero(np.isfinite(rows.events.value[:, 0]))


def finite_values(page):
    rows, read = finite_rows(page)
    return rows.events.value[read, 0].tolist()


class Subscriber:
    """A client of the OPC UA output, which keeps the last value of each variable."""

    def __init__(self, url, names):
        self.last, self.client = {}, Client(url)
        self.client.connect()
        index = self.client.get_namespace_index("urn:nisus")
        self.paths = {f"ns={index};s=motor_winding.{name}": name for name in names}
        subscription = self.client.create_subscription(10, self)
        subscription.subscribe_data_change([self.client.get_node(node) for node in self.paths])

    def datachange_notification(self, node, value, data):
        self.last[self.paths[node.nodeid.to_string()]] = data.monitored_item.Value

    def stop(self):
        self.client.disconnect()


@pytest.fixture
def plant(tmp_path, broker):
    made = Plant(tmp_path, broker)
    yield made
    made.close()


@pytest.mark.parametrize("kind", ["push", "mqtt", "opcua", "modbus", "can"])
def test_the_same_state_from_every_output_whatever_the_source(plant, broker, listener, serve, tmp_path, kind):
    port, dbc = free_port(), tmp_path / "estimate.dbc"
    bus = {"interface": "virtual", "channel": plant.channel, "id": 1536, "dbc": str(dbc)}
    outputs = {"every": 0, "mqtt": {"host": "127.0.0.1", "port": broker.port}, "opcua": {"port": port}, "can": bus}
    twin = pushed_twin(outputs, json.dumps(plant.source(kind)))
    monitored = can.Bus(interface="virtual", channel=plant.channel)
    with publishing(serve, twin) as page, monitored as monitor:
        wait_for(lambda: all(item["connected"] for item in page.engine.published.json()["outputs"]))
        plant.send(kind, page)
        wait_for(lambda: len(finite_rows(page)[1]) >= len(VALUES))
        rows, read = finite_rows(page)
        times = rows.events.t[read]
        if kind not in ("can", "modbus"):  # whose times are those of the bus, and of the answers
            assert times.tolist() == [BEGIN + k * SECOND for k in range(len(VALUES))]
        found = rows.events.value[read, 0].tolist()
        # A device is asked again and again, whether or not its value has changed.
        assert list(dict.fromkeys(found) if kind == "modbus" else found) == list(VALUES)
        log = Log.resume(twin.model, None, rows.events)
        track = fold(twin.estimator, twin.model, log, tuning=twin.tuning)
        mean, std, t = track.mean[-1].tolist(), track.std[-1].tolist(), int(times[-1])

        # HTTP and MQTT
        names = [item.name for item in twin.model.shown_states]
        wait_for(lambda: [m for m in listener.of("nisus/motor_winding/state") if m["time_ns"] == t])
        for found in (page.get("/api/state"), listener.of("nisus/motor_winding/state")[-1]):
            assert found["time_ns"] == t
            assert [item["value"] for item in found["states"]] == mean
            assert [item["std"] for item in found["states"]] == std

        # OPC UA
        paths = [*names, *(f"{name}.std" for name in names), "message"]
        client = Subscriber(f"opc.tcp://127.0.0.1:{port}/nisus", paths)
        wait_for(lambda: len(client.last) == len(paths))
        wait_for(lambda: json.loads(client.last["message"].Value.Value)["time_ns"] == t)
        wait_for(lambda: [client.last[path].Value.Value for path in paths[:-1]] == [*mean, *std])
        assert {client.last[name].StatusCode.name for name in names} == {STATUS_CODES[found["health"]]}
        stamp = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=t // 1000)
        assert abs(client.last[names[0]].SourceTimestamp.replace(tzinfo=UTC) - stamp) <= timedelta(microseconds=1)
        with pytest.raises(ua.UaStatusCodeError):
            client.client.get_node(next(iter(client.paths))).write_value(0.0)
        client.stop()

        # CAN: the last frames, by the DBC that Nisus wrote; float32 rounds to half a unit of its last place.
        database, signals = cantools.database.load_file(dbc), {}
        expected = {f"{name}_mean": float(np.float32(value)) for name, value in zip(names, mean, strict=True)}
        expected |= {f"{name}_std": float(np.float32(value)) for name, value in zip(names, std, strict=True)}
        expected |= {f"{name}_mean_valid": 1 for name in names}

        def received():
            while (frame := monitor.recv(0.0)) is not None:
                if frame.arbitration_id >= 1536:
                    signals.update(database.decode_message(frame.arbitration_id, frame.data))
                    assert frame.data[7] == checksum(frame.arbitration_id, bytes(frame.data[:7]))
            return expected.items() <= signals.items()

        wait_for(received)
        assert {str(signals[f"{name}_mean_grade"]) for name in names} == {state["grade"] for state in found["states"]}


@cases(__file__, "status_codes.csv")
def test_the_status_code_says_whether_a_state_may_be_used_whatever_the_twin(grade, value, code):
    found = values_of(state(float(value) if value else None, grade=grade))
    assert {found[name].StatusCode.name for name in ("winding", "winding.std")} == {code}
    assert (found["winding"].Value.Value is None) == (not value)
    assert found["winding.protection_level"].Value.Value is None


def test_frames_carry_validity_age_and_counter_and_a_checksum_that_is_the_standards():
    # The check value of CRC-8 SAE J1850 over "123456789" is 0x4B; here the identifier is its first four bytes.
    assert checksum(int.from_bytes(b"1234", "little"), b"56789") == 0x4B
    (identifier, mean), (_, std) = frames(1536, state(100.0, age_s=0.5, grade="suspect"), 7)
    assert (identifier, struct.unpack_from("<fBBB", mean)) == (1536, (100.0, 0x37, 1, 50))
    assert struct.unpack_from("<fBBB", std) == (10.0, 0x37, 1, 50)
    (_, lost), _ = frames(1536, state(None, age_s=99.0, grade="withheld"), 8)
    assert struct.unpack_from("<fBBB", lost) == (0.0, 0x78, 0, 255)


@pytest.mark.parametrize(("name", "word"), [("ü", "_"), ("3-pump", "_3_pump"), ("fan", "fan")])
def test_the_names_of_a_dbc_are_those_of_c(serve, tmp_path, name, word):
    section = {"interface": "virtual", "channel": "x", "id": 1536, "dbc": str(tmp_path / "e.dbc")}
    text = (ROOT / "config" / "twins" / "motor_winding.yaml").read_text()
    (tmp_path / f"{name}.yaml").write_text(text)
    page = serve()
    page.engine.twin = load_twin(tmp_path / f"{name}.yaml", overrides={"outputs": json.dumps({"can": section})})
    for _ in range(2):  # its own file is written again
        Publisher(page.engine)
    database = cantools.database.load_file(tmp_path / "e.dbc")
    assert [message.name for message in database.messages][0] == f"{word}_temperature_mean"


@cases(__file__, "refused_outputs.csv")
def test_an_output_that_cannot_be_is_refused_in_one_line(serve, tmp_path, outputs, text):
    plant = Plant(tmp_path, None)
    overrides = {"source": json.dumps(plant.source("can")), "outputs": outputs.replace("{}", str(tmp_path))}
    page = serve()
    with pytest.raises(ConfigError) as error:
        page.engine.twin = load_twin("motor_winding", overrides=overrides)
        Publisher(page.engine)
    assert text in str(error.value) and "\n" not in str(error.value)
    assert (tmp_path / "plant.dbc").read_text() == DBC


def test_a_port_in_use_is_reported_and_delays_nothing(serve, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        twin = pushed_twin({"opcua": {"port": taken.getsockname()[1]}})
        with publishing(serve, twin) as page:
            Plant(tmp_path, None).post(page)
            wait_for(lambda: any("is not served" in text for text in notice_texts(page.engine)))
            assert not page.engine.published.json()["outputs"][0]["connected"]
            wait_for(lambda: page.rows() == len(VALUES))


@cases(__file__, "refused_sources.csv")
def test_a_source_that_cannot_be_is_refused_in_one_line(source, text, monkeypatch):
    monkeypatch.delenv("NISUS_NO", raising=False)
    overrides = {"source": source}
    assert text in error_of(NisusError, lambda: load_twin("motor_winding", overrides=overrides).open_source(ignore))
