"""What a page is told of a twin before it draws anything."""

import pytest

from app.engine.engine import Engine
from app.server.model_json import model_json
from app.twin.twin import load_twin


def told(name):
    twin = load_twin(name)
    return model_json(Engine(twin, lambda report: twin.open_source(report, live=False)))


def test_the_bounds_of_a_commissioned_twin_are_those_of_what_was_normal():
    """Bias and scale of the four rows as the YAML has them: E e² = b² + s²."""
    rows = [(0.123, 0.408), (0.135, 0.447), (0.228, 0.354), (-0.259, 0.405)]
    expected = sum(b * b + s * s for b, s in rows) / 4
    assert told("agv_corridor")["nis_normal"] == pytest.approx(expected, rel=1e-9)
    assert told("motor_winding")["nis_normal"] == 1.0
