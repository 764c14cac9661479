"""One function appends everything to a model, in one order, and names the part that it cannot append."""

import numpy as np
import pytest

from estimators.model.assemble import AppendError, JointParameter, assemble
from estimators.model.coloured import ColouredError
from estimators.model.correction import Ridge
from estimators.model.hybrid import LearnedCorrection
from estimators.models import MODELS
from tests.support import run_python

MODEL = MODELS["motor_winding"]
RIDGE = Ridge(np.array([[20.0], [30.0], [40.0]]), np.array([[0.1], [0.2], [0.1]]), 1.0)


def learned(state="temperature"):
    return LearnedCorrection((state,), ("temperature",), (0.25,), RIDGE)


def test_the_physics_keeps_its_states_first_and_parameters_come_last():
    model = assemble(
        MODEL,
        learned=learned(),
        noises={"temperature": 40.0},
        errors={"winding": ColouredError((4.0,), 300.0)},
        estimated={"winding_error_time": JointParameter(50.0)},
    )
    assert model.state_names == (
        *MODEL.state_names, "temperature_disturbance", "winding_error", "winding_error_time"
    )  # fmt: skip
    assert [item.name for item in model.noises] == [
        *(item.name for item in MODEL.noises), "temperature_learned", "winding_error", "winding_error_time"
    ]  # fmt: skip
    assert [item.name for item in model.parameters] == [
        *(item.name for item in MODEL.parameters), "temperature_disturbance_time"
    ]  # fmt: skip


def test_nothing_appended_is_the_model_itself():
    assert assemble(MODEL) is MODEL


@pytest.mark.parametrize(
    ("given", "part", "words"),
    [
        ({"learned": learned("speed")}, ("learned", ""), "no state 'speed'"),
        ({"noises": {"rate": 1.0, "temperature": -1.0}}, ("noise", "temperature"), "-1 s; it must be positive"),
        ({"errors": {"winding": ColouredError((1.0, 2.0), 3.0)}}, ("error", "winding"), "one for each of 1 rows"),
        ({"estimated": {"mass": JointParameter(1.0)}}, ("estimate", "mass"), "no parameter 'mass' to estimate"),
    ],
)
def test_what_cannot_be_appended_is_named(given, part, words):
    with pytest.raises(AppendError, match=words) as caught:
        assemble(MODEL, **given)
    assert caught.value.part == part


ENCLOSED = """
import hashlib
from estimators.compiled.model import compile_model
from estimators.model.assemble import JointParameter, assemble, joint
from estimators.model.instruments import Instrument
from estimators.models import MODELS
from numba.core.serialize import dumps
model = MODELS["motor_drive"]
instruments = {item.name: Instrument((0.1,)) for item in (model.sensors[0], model.inputs[0])}
made = assemble(model, instruments=instruments, estimated={model.parameters[0].name: JointParameter(0.1)})
for function in (made.f, made.F, made.sensors[0].h, made.sensors[0].H):
    print(hashlib.sha256(dumps([cell.cell_contents for cell in function.__closure__])).hexdigest())
print(sum(compile_model(joint(model, {"yoke_coolant": JointParameter(0.01)})).f.stats.cache_misses.values()))
"""


def test_code_of_a_wrapped_model_is_found_by_another_process():
    """Numba finds the code of a closure by what it encloses, also that of a wrapper around a wrapper."""
    one, two = (run_python(ENCLOSED).stdout for _ in range(2))
    assert one.split()[:4] == two.split()[:4] and len(set(two.split()[:4])) == 4
    assert two.split()[4] == "0", two
