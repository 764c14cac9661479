"""A correction's file beside a twin, and the network of one: what is wrong with it is one line with its place."""

import sys
from pathlib import Path

import numpy as np
import pytest

from app.cli.open_twin import opened_twin
from app.extensions.learned.correction import run_net
from app.twin.twin import load_twin
from estimators.errors import ConfigError
from estimators.models import MODELS
from tests.app.twin.written import refusal, twin_of
from tests.cases import cases
from tests.support import error_of

pytestmark = pytest.mark.usefixtures("inside")

RIGHT = """\
learned: {twin: motor_winding, model: motor_winding, saved: 2026-11-22T10:30:00Z}
kind: gp
corrects: [temperature]
features: [temperature]
noise: {temperature: 0.25}
lengths: [10]
ratio: 1
points: [[20], [30], [40]]
rates: [[0.1], [0.2], [0.1]]
"""
TWIN = """\
model: motor_winding
correction: correction.yaml
source: {type: simulator, seed: 1, step: 1.0, duration: 60}
"""


def corrected(text, **options):
    Path("correction.yaml").write_text(text)
    return twin_of(TWIN, **options)


def test_what_it_says_is_in_the_model():
    model = corrected(RIGHT).model
    noise = model.noises[-1]
    assert (noise.name, noise.unit, noise.variance) == ("temperature_learned", "°C²/s", 0.25)
    # The same content is the same object, and what was compiled of it.
    assert corrected(RIGHT).model.f is model.f
    assert corrected(RIGHT.replace("0.2", "0.3")).model.f is not model.f


def test_its_noise_is_tuned_like_any_other():
    assert "Q.temperature_learned" in corrected(RIGHT).tuning.keys()
    assert corrected(RIGHT, overrides={"Q.temperature_learned": "0.5"}).tuning.q[-1] == 0.5


def test_a_twin_without_is_what_it_was():
    bare = corrected(RIGHT, overrides={"correction": "null"})
    alone = load_twin("motor_winding").model
    assert bare.model.f is alone.f and bare.model.Q is alone.Q and bare.model.noises == MODELS["motor_winding"].noises


@cases(__file__, "refused_corrections.csv")
def test_what_is_wrong_has_its_line(before, after, said):
    assert before in RIGHT
    assert said in error_of(ConfigError, corrected, RIGHT.replace(before, after))


def test_a_file_that_is_not_there():
    assert refusal(TWIN).startswith("motor.yaml:2: correction is 'correction.yaml'; there is no file")


def test_a_page_looks_at_it_too():
    corrected(RIGHT)
    assert Path("correction.yaml").absolute() in opened_twin("motor.yaml").files


def net_file(path, weights, *, kind="DOUBLE"):
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    helper, kinds = onnx.helper, onnx.TensorProto
    weights = np.asarray(weights)
    element = getattr(kinds, kind)
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["z", "w"], ["m"])],
        "line",
        [helper.make_tensor_value_info("z", element, [None, weights.shape[0]])],
        [helper.make_tensor_value_info("m", element, [None, weights.shape[1]])],
        [helper.make_tensor("w", element, weights.shape, weights.ravel())],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.save(model, str(path))
    return path


@pytest.mark.parametrize("kind", ["DOUBLE", "FLOAT"])
def test_a_net_says_the_same_alone_and_among_others(tmp_path, kind):
    weights = np.array([[0.5, -1.0], [2.0, 0.25], [0.0, 3.0]])
    run = run_net(net_file(tmp_path / "net.onnx", weights, kind=kind), 3, 2)
    z = np.random.default_rng(0).normal(0.0, 2.0, (7, 3))
    found = run(z)
    np.testing.assert_allclose(found, z @ weights, rtol=0.0, atol=1e-12 if kind == "DOUBLE" else 1e-5)
    np.testing.assert_array_equal(found, np.concatenate([run(row[None]) for row in z]))


def test_without_onnxruntime_a_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ConfigError, match=r"needs onnxruntime, which is not installed: pip install 'nisus\[learned\]'"):
        run_net(tmp_path / "net.onnx", 1, 1)


def test_a_file_that_is_no_such_net_is_one_line(tmp_path):
    net = net_file(tmp_path / "net.onnx", np.ones((3, 2)))
    with pytest.raises(ConfigError, match="it does not take 2 features"):
        run_net(net, 2, 2)
    with pytest.raises(ConfigError, match="it gives 2 numbers; it must give one for each of 1 corrected"):
        run_net(net, 3, 1)
    net.write_bytes(b"no net")
    assert "cannot be read as an ONNX network" in error_of(ConfigError, run_net, net, 3, 2)
    net.unlink()
    with pytest.raises(ConfigError, match="there is no such file"):
        run_net(net, 3, 2)
