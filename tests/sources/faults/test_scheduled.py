"""Faults of a YAML: each against its own formula, outside its time nothing changes, and errors that name the remedy."""

import numpy as np

from app.twin.twin import load_twin
from estimators.errors import ConfigError
from estimators.log import MARK, READING
from estimators.models import MODELS
from sources.faults.kinds import Fault
from sources.faults.layer import Faults, FaultySource
from sources.simulator import SensorPlan, Simulator
from tests.cases import cases
from tests.sources.can.can_tools import same
from tests.support import error_of, read_all

PACK = MODELS["motor_drive"]
SENSOR = PACK.sensors[0].name
N = 400


def without_marks(events):
    return events.select(events.kind != MARK)


def run(*faults: Fault, seed: int = 3):
    asset = Simulator(PACK, seed=seed, step=1.0, duration=float(N))
    return without_marks(read_all(FaultySource(asset, Faults(PACK, faults, seed=seed))))


def spoken(events, sensor=0):
    mine = events.of_sensor(sensor)
    return events.t[mine] * 1e-9, events.value[mine, 0]


def test_dropouts_come_at_their_rate():
    """A count of N Bernoulli draws, within 4 of its standard deviations."""
    _, plain = spoken(run())
    _, lossy = spoken(run(Fault("dropout", SENSOR, rate=0.3)))
    assert abs(np.isnan(lossy).sum() - 0.3 * N) < 4 * np.sqrt(N * 0.3 * 0.7)
    np.testing.assert_array_equal(lossy[~np.isnan(lossy)], plain[~np.isnan(lossy)])


def test_a_seed_gives_the_same_faults_and_they_touch_nothing_else():
    fault = Fault("outliers", SENSOR, start=100, end=300, size=30.0, rate=0.5)
    plain, wild = run(), run(fault)
    assert same(wild, run(fault)) and not same(wild, plain)
    other = ~((wild.kind == READING) & (wild.channel == 0))
    assert same(plain.select(other), wild.select(other))
    # Neither its window nor a later fault changes its draws.
    t, short = spoken(
        run(Fault("outliers", SENSOR, start=200, end=300, size=30.0, rate=0.5), Fault("dropout", SENSOR, start=390))
    )
    np.testing.assert_array_equal(short[(t >= 200) & (t < 300)], spoken(wild)[1][(t >= 200) & (t < 300)])


def test_each_fault_has_draws_of_its_own_and_of_the_seed():
    """Two faults of the same kind add up as independent ones do; another seed hits other readings."""
    fault = Fault("outliers", SENSOR, size=30.0, rate=0.3)

    def added(seed, *faults):
        return spoken(run(*faults, seed=seed))[1] - spoken(run(seed=seed))[1]

    first, both = added(3, fault), added(3, fault, fault)
    # A correlation of N independent pairs has the standard error 1/√N.
    assert abs(np.corrcoef(first, both - first)[0, 1]) < 4 / np.sqrt(N)
    assert abs(np.corrcoef(first, added(4, fault))[0, 1]) < 4 / np.sqrt(N)


def test_faults_of_one_row_leave_the_others():
    model = MODELS["road_car"]
    plans = {"gnss_position": SensorPlan()}
    plain, shifted = (
        without_marks(
            read_all(
                FaultySource(Simulator(model, seed=1, step=1.0, duration=5.0, sensors=plans), Faults(model, faults))
            )
        )
        for faults in ((), (Fault("bias", "gnss_position", size=7.0, row="north"),))
    )
    fixes = plain.of_sensor(0)
    np.testing.assert_allclose((shifted.value - plain.value)[fixes][:, :2], [[0.0, 7.0]] * 5, atol=1e-12)


YAML = """model: motor_winding
source:
  type: simulator
  duration: 20
  faults:
    - {FAULT}
"""


@cases(__file__, "refused_faults.csv")
def test_the_yaml_says_what_is_wrong_with_a_fault(tmp_path, fault, text):
    path = tmp_path / "pump.yaml"
    path.write_text(YAML.replace("{FAULT}", fault))
    said = error_of(ConfigError, load_twin, path)
    assert text in said and "pump.yaml:6: source.faults[0]" in said


def test_the_yaml_reaches_the_simulator(tmp_path):
    path = tmp_path / "pump.yaml"
    path.write_text(YAML.replace("{FAULT}", "{sensor: winding, kind: dropout, start: 5, end: 10}"))
    events = read_all(load_twin(path).open_source(lambda key, text: None))
    t, values = spoken(events)
    np.testing.assert_array_equal(np.isnan(values), (t >= 5) & (t < 10))
