"""A simulated asset on a bus: what a twin decodes is what the simulator said, to the signals' resolution."""

import uuid

import can
import numpy as np
import pytest

from estimators.errors import SourceError
from estimators.log import INPUT, READING, TRUTH, truth_of
from estimators.model.state_space import Input, Noise, Row, Sensor, State, StateSpaceModel
from sources.can.bus import CanBus
from sources.can.decoder import Decoder
from sources.can.player import Encoder, Player
from sources.simulator import SensorPlan, Simulator, stepped_input
from sources.source import Channel
from tests.models import first_state, second_state
from tests.sources.can.can_tools import Reports, dbc, decoded
from tests.support import Clock, read_all
from tests.waiting import wait_for

ASSET = """VERSION ""
NS_ :
BS_:
BU_: A
BO_ 256 SENSE: 8 A
 SG_ Temp : 0|16@1+ (0.01,-100) [0|0] "degC" A
 SG_ Flow : 23|16@0- (0.01,0) [0|0] "km/h" A
BO_ 257 DRIVE: 2 A
 SG_ Power : 0|16@1- (1,0) [0|0] "W" A
BO_ 258 TRUTH: 8 A
 SG_ TrueTemp : 0|32@1- (0.001,0) [0|0] "K" A
 SG_ Narrow : 32|8@1+ (1,0) [0|200] "" A
"""


def f(x, u, p, dt, out):
    out[0] = x[0] + dt * (u[0] - x[0])
    out[1] = x[1]


MODEL = StateSpaceModel(
    name="asset",
    title="Asset",
    states=(State("temp", "°C", 20.0, 1.0), State("flow", "m/s", 5.0, 1.0)),
    noises=(Noise("temp", "", 0.01), Noise("flow", "", 0.01)),
    inputs=(Input("power", "W", 3.0),),
    sensors=(
        Sensor("temp", (Row("temp", "°C", 0.04),), first_state),
        Sensor("flow", (Row("flow", "m/s", 0.04),), second_state),
    ),
    f=f,
)
CHANNELS = (
    Channel(READING, 0, "temp", ("Temp",), "SENSE", model_units=("°C",)),
    Channel(READING, 1, "flow", ("Flow",), "SENSE", model_units=("m/s",), scale=(-1.0,), offset=(7.0,)),
    Channel(INPUT, 0, "power", ("Power",), "DRIVE", model_units=("W",)),
    Channel(TRUTH, 0, "temp", ("TrueTemp",), "TRUTH", model_units=("°C",)),
    Channel(TRUTH, 1, "flow", ("Narrow",), "TRUTH", model_units=("m/s",), scale=(0.01,)),
)


def asset():
    return Simulator(
        MODEL,
        seed=4,
        step=0.5,
        duration=60.0,
        inputs={"power": stepped_input(times=(0.0, 20.0), values=(3.0, 30.0))},
        sensors={"temp": SensorPlan(drop_every=10)},
    )


class Listener:
    """A bus that keeps what is sent."""

    def __init__(self, fails=0):
        self.frames = []
        self.fails = fails

    def send(self, message):
        if self.fails:
            self.fails -= 1
            raise can.CanOperationError("buffer full")
        self.frames.append(message)

    def shutdown(self):
        pass


def play(tmp_path, clock=None, bus=None, report=lambda key, text: None):
    """Everything at once: the clock says that all is due, in steps below the lateness that is skipped."""
    bus, clock = bus or Listener(), clock or Clock()
    path = dbc(tmp_path, ASSET)
    player = Player(
        asset(), [(path, None)], CHANNELS, interface="fake", channel=0, report=report, connect=lambda: bus, clock=clock
    )

    def wait(seconds):
        clock.now += round(seconds * 1e9)
        times.append(clock.now)
        return False

    times = []
    player._stop.wait = wait
    player.run()
    return bus, path, times, player


def test_what_is_decoded_is_what_was_simulated(tmp_path):
    bus, path, _, player = play(tmp_path)
    expected = read_all(asset())
    decoder = Decoder([(path, None)], CHANNELS, width=1)
    got = decoded(decoder, bus.frames)
    assert player.sent == len(bus.frames)
    for index, step in ((0, 0.01), (1, 0.01 / 3.6)):
        theirs = expected.value[expected.of_sensor(index), 0]
        lost = np.isnan(expected.value[expected.of_sensor(0), 0])
        ours = got.value[got.of_sensor(index), 0]
        assert lost.sum() == 12 and ours.size == theirs.size - lost.sum(), "a lost reading is a lost frame"
        np.testing.assert_allclose(ours, theirs[~lost], atol=step / 2 * 1.0001)
    truth = truth_of(got, 0)[1]
    np.testing.assert_allclose(truth, truth_of(expected, 0)[1], atol=0.00051)
    narrow = truth_of(got, 1)[1]
    assert narrow.size == truth.size == 120 and (narrow == 2.0).all(), "held at the signal's limit"


def test_inputs_are_said_when_they_change_and_every_second(tmp_path):
    bus, path, times, _ = play(tmp_path)
    power = [int.from_bytes(m.data, "little", signed=True) for m in bus.frames if m.arbitration_id == 257]
    assert power == [3] * 20 + [30] * 41


def test_frames_go_out_on_a_schedule_without_drift(tmp_path):
    _, _, times, _ = play(tmp_path)
    assert times == [500_000_000 * k for k in range(1, 121)]


def test_time_in_which_the_process_stood_still_is_skipped(tmp_path):
    class Sleepy(Clock):
        def __call__(self):
            if 10e9 < self.now < 11e9:
                self.now += 30 * 10**9
            return self.now

    reports = Reports()
    bus, _, times, _ = play(tmp_path, clock=Sleepy(), report=reports)
    assert reports.counts == {"asset late": 1} and "delayed by" in reports.texts["asset late"]
    gaps = np.diff(times)
    assert (gaps > 0).all() and (gaps > 10**9).sum() == 1, "no burst follows"


def test_a_frame_that_is_not_sent_is_counted(tmp_path):
    reports = Reports()
    bus, _, _, player = play(tmp_path, bus=Listener(fails=3), report=reports)
    assert reports.counts == {"send failed": 3} and player.sent == len(bus.frames)


def test_what_cannot_be_encoded_is_one_line(tmp_path):
    position = Channel(READING, 0, "fix", ("Temp", "Flow"), "SENSE", convert="east_north")
    with pytest.raises(SourceError, match="fix: convert is east_north; it cannot be encoded"):
        Player(asset(), [(dbc(tmp_path, ASSET), None)], [position], interface="virtual", channel="x")


def test_a_thread_beside_the_listener(tmp_path):
    name, path = uuid.uuid4().hex, dbc(tmp_path, ASSET)
    source = CanBus("virtual", name, Decoder([(path, None)], CHANNELS, width=1))
    fast = Simulator(MODEL, seed=1, step=0.001, duration=0.05)
    player = Player(fast, [(path, None)], CHANNELS, interface="virtual", channel=name)
    player.start()
    batches = []

    def heard():
        batches.append(source.read(0.05))
        return sum((batch.kind == READING).sum() for batch in batches) >= 100

    wait_for(heard)
    player.close()
    source.close()
    assert sum((batch.kind == READING).sum() for batch in batches) == 100 and not player._thread.is_alive()


def test_an_old_reading_is_not_sent_again_with_an_input(tmp_path):
    path = dbc(tmp_path, ASSET)
    shared = (CHANNELS[0], Channel(INPUT, 0, "power", ("Flow",), "SENSE", units=("W",), model_units=("W",)))
    encoder = Encoder([(path, None)], shared)
    second = 1_000_000_000
    assert len(encoder.frames(0, [(INPUT, 0, (1.0,)), (READING, 0, (5.0,))])) == 1
    assert encoder.frames(second // 2, [(INPUT, 0, (2.0,))]) == []
    assert encoder.frames(5 * second, []) == []
    assert encoder.frames(6 * second, [(READING, 0, (float("nan"),))]) == []
    (frame,) = encoder.frames(7 * second, [(INPUT, 0, (float("nan"),)), (READING, 0, (6.0,))])
    decoder = Decoder([(path, None)], shared, width=1)
    got = decoded(decoder, [frame])
    assert got.value[:, 0].tolist() == pytest.approx([2.0, 6.0]), "the input as it was last, and the new reading"
