"""A correction's file beside a twin: what is wrong with it is one line with its place."""

from pathlib import Path

import pytest

from app.cli.open_twin import opened_twin
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
learned: correction.yaml
source: {type: simulator, seed: 1, step: 1.0, duration: 60}
"""


def corrected(text, **options):
    Path("correction.yaml").write_text(text)
    return twin_of(TWIN, **options)


def test_what_it_says_is_in_the_model():
    model = corrected(RIGHT).model
    assert [(item.name, item.unit, item.variance) for item in model.noises][-1] == (
        "temperature_learned",
        "°C²/s",
        0.25,
    )
    # The same content is the same object, and what was compiled of it.
    assert corrected(RIGHT).model.f is model.f
    assert corrected(RIGHT.replace("0.2", "0.3")).model.f is not model.f


def test_its_noise_is_tuned_like_any_other():
    assert "Q.temperature_learned" in corrected(RIGHT).tuning.keys()
    assert corrected(RIGHT, overrides={"Q.temperature_learned": "0.5"}).tuning.q[-1] == 0.5


def test_a_twin_without_is_what_it_was():
    bare = corrected(RIGHT, overrides={"learned": "null"})
    alone = load_twin("motor_winding").model
    assert bare.model.f is alone.f and bare.model.Q is alone.Q and bare.model.noises == MODELS["motor_winding"].noises


@cases(__file__, "learned.csv")
def test_what_is_wrong_has_its_line(before, after, said):
    assert before in RIGHT
    assert said in error_of(ConfigError, corrected, RIGHT.replace(before, after))


def test_a_file_that_is_not_there():
    assert refusal(TWIN).startswith("motor.yaml:2: learned is 'correction.yaml'; there is no file")


def test_a_page_looks_at_it_too():
    corrected(RIGHT)
    assert Path("correction.yaml").absolute() in opened_twin("motor.yaml").files
