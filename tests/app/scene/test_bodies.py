"""The motor and the cells: their shapes, and that colours and heights are those of the estimate."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.charts.colors import ESTIMATE, LIGHT, gradient
from app.scene.machine_scenes import HEIGHT, BatteryScene, MotorScene, mesh, sectors
from app.scene.renderer import NO_AXIS, Choice, Choices, choices_of
from config.schema import SceneSection, ViewSection
from estimators.errors import ConfigError
from estimators.models import MODELS


def volume(vertices, faces):
    """Of a closed surface, by the divergence theorem; its sign says whether the triangles turn outwards."""
    a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
    return abs(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("part", ["yoke", "tooth", "winding", "magnet"])
def test_a_slice_is_a_solid_and_slices_do_not_share_space(part):
    slices = sectors(part)
    for inner, outer, start, end, half in slices:
        wedge = 0.5 * np.radians(end - start) * (outer**2 - inner**2) * 2 * half
        # Chords of at most some 4 degrees lie 0.1 % within the arc.
        got = [volume(*mesh([(inner, outer, start, end, half)]))]
        assert got == pytest.approx([wedge], rel=2e-3)
    ends = np.array([[start, end] for _, _, start, end, _ in slices])
    assert np.all(ends[1:, 0] >= ends[:-1, 1] - 1e-9)
    assert ends.min() >= (0.0 if part == "magnet" else 90.0) and ends.max() <= 360.0


def belief(mean, std):
    return SimpleNamespace(mean=np.array(mean), cov=np.diag(np.square(std)), points=(), peaks=())


def test_a_part_in_doubt_is_striped_and_one_that_is_known_is_not(server):
    model = MODELS["motor_drive"]
    parts = {"winding": "winding", "yoke": "yoke", "magnet": "magnet"}
    scene = MotorScene(server.scene, model, parts, LIGHT)
    std = np.full(model.nx, 0.001)
    std[model.state_names.index("magnet")] = 8.0
    mean = np.full(model.nx, 40.0)
    mean[model.state_names.index("winding")] = 60.0
    scene.draw(None, belief(mean, std))
    winding, yoke, magnet = ([tuple(handle.color) for handle in handles] for handles in scene._parts)
    assert len(set(winding)) == len(set(yoke)) == 1 and len(set(magnet)) == 3
    # The scale goes from 40 - 16 to 60 or more; warmer is further along it.
    colors = [tuple(color) for color in gradient(ESTIMATE.colors)[:255]]
    places = [colors.index(color) for color in (magnet[0], yoke[0], magnet[2], winding[0])]
    assert places == sorted(places) and places[0] < 30
    assert magnet[1] == yoke[0]
    assert scene._bar._texts[2].text == "magnet  40.0 ± 16.0 °C"
    assert scene._bar.title.text == "temperature [°C]"
    scene.draw(None, belief(np.full(model.nx, np.nan), std))
    assert {tuple(handle.color) for handles in scene._parts for handle in handles} == {(205, 205, 210)}
    assert scene._bar._texts[2].text == "magnet  –"
    scene.root.remove()


def test_cells_are_as_full_as_they_are_charged(server):
    model = MODELS["battery_cell"]
    scene = BatteryScene(server.scene, model, ("soc",), ("temperature",), LIGHT)
    mean, std = np.zeros(model.nx), np.full(model.nx, 0.01)
    mean[model.state_names.index("soc")], mean[model.state_names.index("temperature")] = 0.99, 25.0
    scene.draw(None, belief(mean, std))
    fill, doubt = scene._fills[0], scene._doubts[0]
    assert fill.scale[2] == pytest.approx(0.99 * HEIGHT)
    assert fill.position[2] == pytest.approx(0.5 * 0.99 * HEIGHT)
    # From 97 % up to full, and no further.
    assert doubt.position[2] - doubt.scale[2] / 2 == pytest.approx(0.97 * HEIGHT)
    assert doubt.position[2] + doubt.scale[2] / 2 == pytest.approx(HEIGHT)
    assert scene._texts[0].text == "99.0 ± 2.0 %" and scene._bar.title.text == "temperature [°C]"
    scene.draw(None, belief(np.full(model.nx, np.nan), std))
    assert not fill.visible and not doubt.visible and scene._texts[0].text == "–"
    scene.root.remove()


def test_every_twin_has_the_belief_beside_its_picture():
    section = ViewSection(scene=SceneSection(kind="motor", parts={"winding": "temperature"}))
    show, x, y = choices_of(MODELS["motor_winding"], section, truth=False)
    assert (show.options, show.first) == (("motor", "belief"), "motor")
    assert (x.first, y.first, x.of) == ("temperature", "rate", "belief")
    drive = ViewSection(scene=SceneSection(axes=("magnet", "yoke")))
    *_, x, y, z = choices_of(MODELS["motor_drive"], drive, truth=False)
    assert (x.first, y.first, z.first) == ("magnet", "yoke", "none")


@pytest.mark.parametrize(
    "fields",
    [{"kind": "motor"}, {"kind": "battery"}, {"kind": "vehicle"},
     {"kind": "battery", "charge": ("a", "b"), "temperature": ("c",)}],
)  # fmt: skip
def test_a_picture_that_lacks_something_is_refused(fields):
    with pytest.raises(ValueError, match="has no|has not as many"):
        SceneSection(**fields)


STATES = ("a", "b", "c")


@pytest.fixture
def choices():
    return Choices([
        Choice("show", "Show", ("motor", "belief"), "motor"),
        Choice("x", "x", STATES, "a", "belief"), Choice("y", "y", STATES, "b", "belief"),
        Choice("z", "z", (*STATES, NO_AXIS), "none", "belief"),
        Choice("single", "Single", ("one",), "one"),
    ])  # fmt: skip


def test_only_what_there_is_to_choose_is_offered(choices):
    assert [item["key"] for item in choices.json()] == ["show"]
    choices.choose("show", "belief")
    assert [(item["key"], item["value"]) for item in choices.json()] == [
        ("show", "belief"), ("x", "a"), ("y", "b"), ("z", "none"),
    ]  # fmt: skip


def test_two_axes_never_have_the_same_state(choices):
    choices.choose("x", "b")
    assert [choices.values()[axis] for axis in "xyz"] == ["b", "a", "none"]
    choices.choose("z", "c")
    choices.choose("y", "c")
    assert [choices.values()[axis] for axis in "xyz"] == ["b", "c", "a"]
    # There is nothing that x could have instead.
    choices.choose("z", "none")
    with pytest.raises(ConfigError, match="b is on the x axis already"):
        choices.choose("z", "b")


@pytest.mark.parametrize(("key", "value", "said"), [("w", "a", "no choice 'w'"), ("x", "d", "x is 'd'; it must be")])
def test_what_there_is_not_is_refused(choices, key, value, said):
    before = choices.values()
    with pytest.raises(ConfigError, match=said):
        choices.choose(key, value)
    assert choices.values() == before
