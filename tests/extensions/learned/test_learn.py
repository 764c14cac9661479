"""`nisus learn`: a body in a shell whose heating the model leaves out; what is kept, what is refused, what is said."""

import numpy as np
import pytest
import yaml

from app.extensions.learned.correction import learned_of
from app.extensions.learned.schema import load_correction
from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from estimators.diagnostics.score import score
from estimators.log import TRUTH, truth_of
from tests.app.twin import test_shipped as shipped
from tests.cases import cases
from tests.support import folded

from .test_correction import net_file

MODEL = """\
from estimators.model import Input, Noise, Row, Sensor, State, StateSpaceModel


def f(x, u, p, dt, out):
    out[0] = x[0] + dt * 0.05 * (x[1] - x[0])
    out[1] = x[1] + dt * (0.05 * (x[0] - x[1]) - 0.02 * x[1])


def h(x, u, p, out):
    out[0] = x[1]


Vessel = StateSpaceModel(
    name="vessel", title="A body in a shell",
    states=(State("body", "°C", mean=0.0, std=1.0), State("shell", "°C", mean=0.0, std=1.0)),
    inputs=(Input("load", "A"),),
    noises=(Noise("body", "°C²/s", 0.05), Noise("shell", "°C²/s", 0.001)),
    sensors=(Sensor("gauge", (Row("gauge", "°C", 0.01),), h=h),),
    f=f, max_step=1.0,
)
"""
YAML = """\
model: ./vessel.py:Vessel
source:
  type: table
  files: run.csv
  time: {column: t, unit: s}
  inputs: {load: {columns: load}}
  sensors: {gauge: {columns: gauge}}
  truth: {body: {columns: body}}
"""
LEARN = "--corrects", "body", "--features", "load", "--window", 10


def heating(load):
    """°C/s, of which the model knows nothing."""
    return 0.4 * load**2


def vessel(folder, heated, seed=7):
    """A recording of 1,500 s and its twin."""
    rng = np.random.default_rng(seed)
    steps = 1500
    load = np.repeat(rng.uniform(0.0, 2.0, steps // 25), 25)
    x = np.zeros((steps, 2))
    for k in range(1, steps):
        body, shell = x[k - 1]
        x[k] = body + 0.05 * (shell - body), shell + 0.05 * (body - shell) - 0.02 * shell
        x[k, 0] += heated * heating(load[k - 1]) + rng.normal(0.0, 0.05)
        x[k, 1] += rng.normal(0.0, 0.03)
    rows = np.column_stack((np.arange(steps), load, x[:, 1] + rng.normal(0.0, 0.1, steps), x[:, 0]))
    np.savetxt(folder / "run.csv", rows, delimiter=",", header="t,load,gauge,body", comments="")
    (folder / "vessel.py").write_text(MODEL)
    path = folder / "vessel.yaml"
    path.write_text(YAML)
    return path


@pytest.fixture(scope="module")
def heated(tmp_path_factory):
    return vessel(tmp_path_factory.mktemp("heated"), 1.0)


@pytest.mark.parametrize("kind", ["ridge", "gp"])
def test_what_the_model_leaves_out_is_learned_kept_and_folded(heated, kind, nisus):
    if kind == "gp":
        pytest.importorskip("sklearn")
    keep = heated.with_name(f"{kind}.yaml")
    done = nisus("learn", heated, *LEARN, "--kind", kind, "--degree", 2, "--keep", keep)
    assert "Better on blocks from which it did not learn." in done.out and "kept" in done.err
    alone = load_twin(heated)
    noise = {"correction": keep.name, "noise.body.variance": "0.03"}
    twin = load_twin(heated, overrides=noise)
    assert [item.name for item in twin.model.noises] == ["body", "shell", "body_learned"]
    correction = learned_of(load_correction(keep)[0], keep).correction
    z = np.linspace(0.1, 1.9, 19)[:, None]
    # Noise of 0.05 °C a step is a rate of 0.016 °C/s of a window; most windows see two loads.
    np.testing.assert_allclose(correction.mean(z)[:, 0], heating(z[:, 0]), rtol=0.0, atol=0.1)
    errors = {}
    for name, each in (("physics", alone), ("hybrid", twin)):
        log, _ = read_log(each, None)
        track = folded(each.estimator, each.model, log, each.tuning).track
        errors[name] = score(track, log.events, each.model).states["body"]
    # The noise is what the command printed. Most of the error is gone.
    assert errors["hybrid"].rmse < 0.4 * errors["physics"].rmse
    assert errors["hybrid"].coverage > 0.85 > errors["physics"].coverage


def test_where_the_model_has_all_of_it_nothing_is_kept(tmp_path, nisus):
    # A gain must exceed two standard errors. Of 17 such logs (seed 7, and 100 to 107 by both kinds) one did by chance.
    path = vessel(tmp_path, 0.0, seed=101)
    keep = tmp_path / "none.yaml"
    done = nisus.run("learn", path, *LEARN, "--kind", "ridge", "--keep", keep)
    assert done.status == 1 and "Not better than the physics alone" in done.out and not keep.exists()


def test_json_has_all_of_it(heated, nisus):
    found = nisus("learn", heated, *LEARN, "--kind", "ridge", "--degree", 2, "--json").json
    assert found["better"] and found["reasons"] == []
    told = found["held_out"]
    physics, wider, corrected = (told[key]["states"]["body"] for key in ("physics", "physics_wider", "corrected"))
    assert corrected["rms"] < 0.5 * min(physics["rms"], wider["rms"])
    assert corrected["crps"] < 0.5 * min(physics["crps"], wider["crps"])
    windows = found["windows"]["held_out"]["states"]["body"]
    assert windows["rms"]["corrected"] < 0.5 * windows["rms"]["physics"]
    assert windows["drift"]["corrected"] < 0.5 * windows["drift"]["physics"]


def test_a_net_is_judged_kept_and_folded(heated, nisus):
    # A line in the load for what is a parabola: 0.4 load² of loads up to 2.
    net = net_file(heated.with_name("net.onnx"), [[0.6]], kind="FLOAT")
    keep = heated.with_name("net.yaml")
    more = "--kind", "net", "--net", net, "--keep", keep, "--estimator", "enkf"
    assert "Blocks held out, folded" in nisus("learn", heated, *LEARN, *more).out
    assert yaml.safe_load(keep.read_text())["net"] == "net.onnx"
    twin = load_twin(heated, overrides={"correction": keep.name, "estimator": "filterpy-ekf"})
    assert twin.model.black_box
    log, _ = read_log(twin, 100.0)
    track = folded(twin.estimator, twin.model, log, twin.tuning).track
    assert np.isfinite(track.mean[log.events.kind == TRUTH]).all()


@cases(__file__, "refused_learn.csv")
def test_wrong_arguments_are_one_line(heated, nisus, arguments, said):
    assert said in nisus.refuses("learn", heated, *LEARN, "--kind", "ridge", *arguments.split())


def test_what_was_learned_of_the_magnet_holds_where_it_was_not_learned():
    def last(name):
        events, track = (fold := shipped.folded(name)).log.events, fold.track
        rows, values = truth_of(events, 3)
        rows, values = rows[(late := events.t[rows] >= events.t[0] + 1_200_000_000_000)], values[late]
        return float(np.sqrt(np.mean((track.mean[rows, 3] - values) ** 2)))

    # Physics of a data sheet, with what 20 minutes taught: as the opening text says, and nearer than fitted physics.
    assert last("motor_bench_hybrid") == pytest.approx(0.627, abs=5e-3)
    assert last("motor_bench") == pytest.approx(0.937, abs=5e-3)
