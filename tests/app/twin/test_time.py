"""What of a twin's time comes from its YAML, and what from its model."""

import json

import numpy as np
import pytest

from app.cli.arguments import FoldCommand
from app.cli.fold import fold_twin
from app.twin.ingest import Ingest
from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from estimators.errors import ConfigError
from estimators.log import MAINTENANCE, TICK
from estimators.track import STALE
from tests.app.scripted import Stepped, pull_all, readings
from tests.skips import recorded
from tests.support import as_log, folded

TWIN = """
model: motor_winding
time: {%s}
source: {type: simulator, seed: 1, step: 2.0, duration: 600, sensors: {winding: {every: %d}}}
%s
"""


def made(tmp_path, time="horizon: 2", every=1, more=""):
    path = tmp_path / "motor.yaml"
    path.write_text(TWIN % (time, every, more))
    return path


def test_the_yaml_wins(tmp_path):
    twin = load_twin(made(tmp_path, "degraded_after: 4.5"))
    assert twin.policy.degraded_after == 4.5 and twin.degraded.reason == "time.degraded_after"


@pytest.mark.parametrize(
    ("every", "gaps", "seconds", "stale"),
    [(1, [2] * 8, 6.0, 15.0), (4, [1] * 50 + [8] * 4 + [1] + [7200] * 3, 24.0, 96.0)],
)
def test_three_periods_of_the_slowest_sensor_and_no_more_than_stale(tmp_path, every, gaps, seconds, stale):
    """The winding's rate is a random walk: nothing of it decays. A rate lasts for four rows; three pauses are none."""
    (tmp_path / "a.csv").write_text("".join(["t,T\n", *(f"{t},20\n" for t in np.cumsum([0, *gaps]))]))
    table = "{type: table, files: a.csv, time: {column: t}, sensors: {winding: {columns: T}}}"
    for overrides in ({}, {"source": table}):
        policy = load_twin(made(tmp_path, every=every), overrides=overrides).policy
        assert (policy.degraded_after, policy.stale_after) == (seconds, stale)
    assert load_twin(made(tmp_path, "stale_after: 15", every=every)).policy.degraded_after == min(seconds, 15.0)


def test_a_model_that_decays_gives_its_slowest_time_constant():
    """gripper_contact forgets within 0.95 s, so the least holds; the bench's magnet takes minutes, so stale_after."""
    assert load_twin("gripper_contact").degraded.seconds == 3.0
    slow = load_twin("motor_bench", overrides={"time.stale_after": "10000"}).degraded
    assert slow.seconds == pytest.approx(399.0, abs=0.5) and "399" in slow.reason


def test_large_ensembles_do_not_go_back():
    """400 MB a snapshot: they are 4096 events apart, and each event takes seconds."""
    large = load_twin("thermal_field_large")
    assert large.late.inflate and "4096 events x 50," in large.late.reason
    small = load_twin("motor_winding")
    assert not small.late.inflate and "64 events" in small.late.reason
    exact = load_twin("thermal_field_large", overrides={"time.late": "exact"})
    assert not exact.late.inflate


def test_a_filter_of_one_gain_cannot_inflate(tmp_path):
    with pytest.raises(ConfigError, match="motor.yaml:3: estimator kf-steady: readings bring their own variance"):
        load_twin(made(tmp_path, "late: inflate", more="estimator: kf-steady"))


def test_maintenance_of_the_yaml_is_in_the_fold(tmp_path, capsys):
    more = "maintenance:\n- {at: 100, what: new fan, states: [rate]}\n"
    out = tmp_path / "track.parquet"
    assert fold_twin(FoldCommand(str(made(tmp_path, more=more)), out=out, json=True)) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["degraded_after"]["seconds"] == 6.0 and told["late"]["inflate"] is False
    assert told["wrong_time"] == told["stale"] == told["inflated"] == 0
    import pyarrow.parquet as pq

    table = pq.read_table(out).to_pandas()
    rows = table[table.event == "maintenance"]
    assert rows.seconds.tolist() == [100.0]
    assert table.model_version.tolist() == [1 + (k >= rows.index[0]) for k in table.index]
    assert table.tuning_version.nunique() == 1


def paused(tmp_path, times, after, known=0):
    """A cell whose tester wrote rows at these times, with a current from `known` on, its log, and counts."""
    (tmp_path / "log.csv").write_text("\n".join(["t,i,v,c", *(f"{t},{'1' * (t >= known)},3.6,25.0" for t in times)]))
    path = tmp_path / "cell.yaml"
    path.write_text(
        "model: battery_cell\nparameters: {r0: {std: 0.005, role: estimated}}\nprior: {soc: {mean: 0.45, std: 0.2}}\n"
        f"time: {{paused_after: {after}}}\nsource:\n  {{type: table, files: log.csv, time: {{column: t}}, inputs: "
        "{current: {columns: i}}, sensors: {voltage: {columns: v}, temperature: {columns: c}}}\n"
    )
    twin = load_twin(path)
    return twin, *read_log(twin, None)


def test_inputs_are_unknown_over_a_pause(tmp_path):
    """A logger that was off from 50 to 400 s: what a cell was drained of meanwhile is not in the file."""
    times = *range(51), *range(400, 420)
    _, log, counts = paused(tmp_path, times, 400)
    assert not np.any(log.events.kind == MAINTENANCE) and counts["paused"] == 0
    twin, log, counts = paused(tmp_path, times, 60)
    fold = folded(twin.estimator, twin.model, log, twin.tuning)
    rows = np.flatnonzero(log.events.kind == MAINTENANCE)
    assert log.t[rows].tolist() == [400_000_000_000 - 1] * 3
    assert [twin.model.state_names[k] for k in log.channel[rows]] == ["soc", "v1", "temperature"]
    np.testing.assert_allclose(fold.track.std[rows[-1], :3], [0.2, 0.02, 3.0], rtol=1e-12)
    assert fold.track.std[rows[-1], 3] < 0.005
    assert counts["paused"] == 1


def test_an_input_whose_first_value_is_late_is_told(tmp_path, capsys):
    for known, count in ((3, 0), (20, 1)):
        assert paused(tmp_path, range(50), 60, known)[2]["input without value"] == count
    assert "nisus: current has no value in the first 20 s: 0 A was used in its place\n" in capsys.readouterr().err


def test_a_logger_of_one_row_a_minute_does_not_pause_all_the_time(tmp_path):
    """Rows every 61 s are no pauses of more than 60 s, 400 s after them are one; batches of any size say the same.

    Three missing rows make the cell degraded, and twelve stale, though it settles within minutes.
    """
    twin, log, counts = paused(tmp_path, [*range(0, 1830, 61), 2230, 2291], 60)
    assert (twin.policy.degraded_after, twin.policy.stale_after) == (183.0, 732.0)
    rows = np.flatnonzero(log.events.kind == MAINTENANCE)
    # Of the first row nothing is usual yet.
    assert counts["paused"] == 2 and set(log.t[rows].tolist()) == {61_000_000_000 - 1, 2_230_000_000_000 - 1}
    events = log.events.select(log.events.kind != MAINTENANCE)
    said = []
    ingest = Ingest(twin.model, 0, lambda key, text: said.append((key, text)), unknown=twin.unknown_inputs)
    for k in range(0, len(events), 7):
        ingest.take(events.select(slice(k, k + 7)))
    ingest.finish()
    assert [text.split(",")[0] for key, text in said if key == "paused"] == [
        "no event for 61 s until 61 s", "no event for 461 s until 2230 s",
    ]  # fmt: skip


@pytest.mark.parametrize(("gap", "degraded", "ticks"), [(400, 30, 20), (9, 3, 0), (120, 130, 0)])
@pytest.mark.parametrize("estimator", ["kf", "ukf"])
def test_a_gap_has_rows_of_the_prediction_and_changes_no_other(tmp_path, gap, degraded, ticks, estimator):
    times = [*range(40), *range(39 + gap, 79 + gap)]
    (tmp_path / "log.csv").write_text("\n".join(["t,y", *(f"{t},{40 + 0.01 * t + t % 3}" for t in times)]))
    path = tmp_path / "twin.yaml"
    path.write_text(
        f"model: motor_winding\nestimator: {estimator}\ntime: {{degraded_after: {degraded}, stale_after: 300}}\n"
        "source: {type: table, files: log.csv, time: {column: t}, sensors: {winding: {columns: y}}}\n"
    )
    twin, log = recorded(path)
    replayed = Stepped()  # degraded after 5 s
    replayed.put(readings(times, np.full(len(times), 40.0)))
    assert (pull_all(replayed.engine).events.kind == TICK).sum() == (20 if gap > 10 else 0)
    fold = folded(twin.estimator, twin.model, log, twin.tuning, policy=twin.policy)
    rows = log.events.kind == TICK
    assert rows.sum() == ticks and log.n == len(times) + ticks
    alone = folded(twin.estimator, twin.model, as_log(log.events.select(~rows)), twin.tuning, policy=twin.policy)
    for name in ("mean", "std", "nis", "innovation", "whitened"):
        np.testing.assert_array_equal(getattr(fold.track, name)[~rows], getattr(alone.track, name), err_msg=name)
    if ticks:
        # The innovation after the gap is y - H x, and its variance H P H + R, of the prediction at its end.
        first, last = np.flatnonzero(rows)[[0, -1]]
        t = log.t[first - 1 : last + 2] * 1e-9
        assert np.all(np.diff(t[:-1], 2) > 0.0) and t[-2] == pytest.approx(t[-1], abs=1e-8)
        predicted = log.value[last + 1, 0] - alone.track.innovation[40, 0]
        variance = alone.track.innovation_std[40, 0] ** 2 - twin.tuning.get("R.winding")
        assert fold.track.mean[last, 0] == pytest.approx(predicted, rel=1e-9)
        assert fold.track.std[last, 0] ** 2 == pytest.approx(variance, rel=1e-6)
        assert {fold.track.health[row] for row in (first, last)} == {fold.track.health[first - 1], STALE}


@pytest.mark.parametrize("how", ["exact", "inflate"])
def test_late_rows_of_a_table_are_used_either_way(tmp_path, how, capsys):
    lines = [f"{k}.0,{40 + 0.01 * k:.2f}" for k in range(300)]
    lines[100], lines[101] = lines[101], lines[100]
    (tmp_path / "log.csv").write_text("\n".join(["t,y", *lines]))
    (tmp_path / "twin.yaml").write_text(
        f"model: motor_winding\nestimator: kf\ntime: {{late: {how}}}\n"
        "source: {type: table, files: log.csv, time: {column: t}, sensors: {winding: {columns: y}}}\n"
    )
    out = tmp_path / "track.parquet"
    assert fold_twin(FoldCommand(str(tmp_path / "twin.yaml"), out=out, json=True)) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["readings"] == 300 and told["stale"] == 0
    assert told["inflated"] == (1 if how == "inflate" else 0)
