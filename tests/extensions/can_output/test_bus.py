import shlex
from collections import Counter
from typing import Any

import can
import numpy as np
import pytest

from app.extensions.can_output import bus
from app.extensions.can_output.arguments import BusCommand
from app.twin.sources.asset import make_asset
from app.twin.sources.can import make_player
from app.twin.twin import load_twin
from estimators.log import INPUT, READING, TRUTH, truth_of
from sources.source import ignore
from tests.cases import cases
from tests.support import Clock, read_all


def play_at_once(player, duration):
    clock = Clock()
    player._clock, player._stop.wait = clock, clock.wait
    player.run()


def events(*, log):
    source = load_twin("motor_can", log_files=[log]).open_source(lambda key, text: None, live=False)
    events = read_all(source)
    source.close()
    return events


@pytest.mark.parametrize("suffix", bus.FORMATS)
def test_what_is_recorded_is_what_the_asset_said(suffix, tmp_path, monkeypatch):
    monkeypatch.setattr(bus, "_play", play_at_once)
    file = tmp_path / f"drive{suffix}"
    settings = ("source.asset.duration=12",)
    assert bus.play_bus(BusCommand("motor_can", interface="virtual", set=settings, record=file)) == 0
    got = events(log=file)
    twin = load_twin("motor_can", overrides={"source.asset.duration": "12"})
    section: Any = twin.config.source
    simulator = make_asset(twin.loaded, twin.model, section.asset, ("source", "asset"))
    said = read_all(simulator)
    sensors = [
        [batch.value[(batch.kind == READING) & (batch.channel == k), 0] for batch in (got, said)] for k in range(3)
    ]
    states = [[truth_of(batch, k)[1] for batch in (got, said)] for k in range(4)]
    assert (got.kind == TRUTH).sum() == (said.kind == TRUTH).sum() == 120, "one block of true states a step"
    for ours, theirs in sensors + states:
        assert ours.size == 120
        np.testing.assert_allclose(ours, theirs, atol=0.00501, err_msg="half of the signal's 0.01 °C")
    pulled = got.value[(got.kind == INPUT) & np.isfinite(got.value[:, 1]), 1]
    assert dict(Counter(pulled.tolist())).keys() == {60.0, 160.0}, "the cycle's first step of i_q is at 8 s"


def test_listeners_hear_what_the_bus_took(monkeypatch):
    twin = load_twin("motor_can", overrides={"source.asset.duration": "1"})
    player = make_player(twin.loaded, twin.model, ignore, interface="virtual", channel="test-listeners")[1]
    ear = can.Bus(interface="virtual", channel="test-listeners")
    heard: list[can.Message] = []
    player.listeners.append(heard.append)
    play_at_once(player, None)
    on_bus = []
    while (message := ear.recv(0)) is not None:
        on_bus.append((message.arbitration_id, bytes(message.data)))
    assert [(message.arbitration_id, bytes(message.data)) for message in heard] == on_bus
    assert player.sent == len(on_bus) > 0
    player.close()
    ear.shutdown()


@pytest.mark.parametrize(
    ("interface", "channel", "expected"),
    [
        ("virtual", None, "motor"),
        ("udp_multicast", None, bus.GROUP),
        ("udp_multicast", "239.0.0.1", "239.0.0.1"),
        ("socketcan", "can0", "can0"),
        ("vector", "1", 1),
    ],
)
def test_the_channel(interface, channel, expected):
    assert (
        bus._channel(BusCommand("motor_can", interface=interface, channel=channel), load_twin("motor_can")) == expected
    )


@cases(__file__, "bad_arguments.csv")
def test_a_wrong_argument_is_one_line(said, command, nisus, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert said in nisus.refuses("bus", *shlex.split(command))
    assert not list(tmp_path.iterdir())


def test_the_json_has_the_fields_of_the_guide(nisus, tmp_path):
    options = ("--interface", "virtual", "--record", tmp_path / "drive.blf", "--duration", 0.2, "--json")
    assert nisus("bus", "motor_can", *options).json.keys() == {"twin", "frames", "counts"}
