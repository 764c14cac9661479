"""Gripper, beams, beacons and surface: that what is drawn lies where geometry, done by hand, has it."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.charts.colors import LIGHT
from app.scene.field_scenes import SURFACE_HEIGHT, FieldSurfaceScene
from app.scene.machine_scenes import FINGER, PAD, PART_WIDTH, GripperScene
from app.scene.scene import History, Shapes, about_z
from app.scene.vehicle_scene import FADING_S, MAX_AGE_S, Beacons, Beams, PeakTrail, VehicleScene
from config.schema import SceneSection
from estimators.diagnostics.field_pictures import Picture
from estimators.log import READING, TRUTH
from estimators.models import MODELS
from estimators.track import GATED
from estimators.tuning import Tuning

GRIPPER, AGV, ROVER = (MODELS[name] for name in ("gripper_contact", "agv_corridor", "uwb_rover"))
JAWS = {"surface": "surface", "depth": "depth", "contact": "contact"}


def rows(model, told):
    """A history of (second, kind, channel, values, verdict)."""
    found = History(model.nx, model.width, 16)
    found.n = len(told)
    for k, (second, kind, channel, values, verdict) in enumerate(told):
        found.column("t")[k] = int(second * 1e9)
        found.column("kind")[k], found.column("channel")[k], found.column("verdict")[k] = kind, channel, verdict
        found.column("value")[k] = np.nan
        found.column("value")[k, : len(values)] = values
    return found


def gripper(mean, cov=None, points=None):
    """A belief by the names of states."""
    order = GRIPPER.state_names
    x = np.array([mean.get(name, 0.0) for name in order], float)
    return SimpleNamespace(
        mean=x, cov=np.zeros((5, 5)) if cov is None else cov, points=np.zeros((0, 5)) if points is None else points
    )


def ends(box, axis=0):
    """From where to where a box of dimension one reaches when scaled."""
    size = box.dimensions[axis] * box.scale[axis]
    return box.position[axis] - size / 2, box.position[axis] + size / 2


def test_a_finger_stands_before_the_part_and_its_pad_gives_way(server):
    scene = GripperScene(server.scene, GRIPPER, JAWS, LIGHT)
    none = rows(GRIPPER, [])
    scene.draw(none, gripper({"surface": 44.0, "depth": -20.0}))
    (steel, pad), (far_steel, far_pad) = scene._fingers
    assert ends(pad) == pytest.approx((24.0 - PAD, 24.0)) and tuple(pad.color) == LIGHT.previous
    assert steel.position[0] == pytest.approx(24.0 - PAD - FINGER / 2)
    # The other finger is as far beyond the part.
    assert ends(far_pad) == pytest.approx((44.0 + PART_WIDTH + 20.0, 44.0 + PART_WIDTH + 20.0 + PAD))
    assert far_steel.position[0] > ends(far_pad)[1]
    assert scene._part.position[0] == pytest.approx(44.0 + PART_WIDTH / 2)
    assert scene._says.text == "contact 0 %"

    # Touching, 1 mm deep: its face is at the part's, and the pad is 1 mm thinner.
    scene.draw(none, gripper({"surface": 44.0, "depth": 1.0, "contact": 1.0}))
    assert ends(pad) == pytest.approx((45.0 - PAD, 44.0)) and tuple(pad.color) == LIGHT.estimate
    # As deep without touching, which a belief may hold: nothing presses.
    scene.draw(none, gripper({"surface": 44.0, "depth": 1.0, "contact": 0.0}))
    assert ends(pad) == pytest.approx((45.0 - PAD, 45.0))
    scene.root.remove()


def test_a_gripper_shows_how_sure_it_is_and_what_is_true(server):
    rng = np.random.default_rng(1)
    names = GRIPPER.state_names
    j, k = names.index("surface"), names.index("depth")
    draws = rng.multivariate_normal([44.0, -20.0], [[4.0, -3.0], [-3.0, 5.0]], 200_000)
    cov = np.zeros((5, 5))
    cov[np.ix_([j, k], [j, k])] = [[4.0, -3.0], [-3.0, 5.0]]
    cloud = np.full((3, 5), np.nan)
    cloud[:2] = 0.0
    cloud[:2, j] = 40.0, 48.0
    scene = GripperScene(server.scene, GRIPPER, JAWS, LIGHT)
    told = rows(GRIPPER, [(0.0, TRUTH, 0, [0.0, -19.0, 0.0, 43.0], 0)])
    scene.draw(told, gripper({"surface": 44.0, "depth": -20.0}, cov, cloud))
    surface, finger = scene._doubts
    assert np.subtract(*ends(surface)[::-1]) == pytest.approx(8.0)
    # The finger is at the sum of two states that doubt against each other; 200,000 draws know a std to 0.2 %.
    assert np.subtract(*ends(finger)[::-1]) == pytest.approx(4 * draws.sum(axis=1).std(), rel=0.01)
    assert scene._where.text == "part at 44.0 ± 4.0 mm"
    np.testing.assert_allclose(np.sort(scene._cloud.points[:, 0]), [40.0, 48.0])
    assert set(np.unique(scene._truth.points[..., 0])) == {24.0, 43.0} and scene._truth.visible
    # Nothing stands for what is not a number.
    scene.draw(told, gripper({"surface": np.nan, "depth": -20.0}))
    drawn = [scene._part, scene._palm, scene._gap, scene._cloud, scene._truth, *scene._doubts, scene._says]
    assert not any(handle.visible for handle in drawn)
    scene.root.remove()


def test_beams_end_at_walls_and_at_what_was_read(server):
    angles = {"scan": (0.0, np.pi / 2, np.pi, -np.pi / 2)}
    beams = Beams(Shapes(server.scene, "/beams"), AGV, angles, LIGHT, dot=0.1)
    mean, p = np.array([2.0, 0.5, np.pi / 2]), Tuning.of(AGV).p
    # It faces north, 2 m east of the middle: walls are 1 m ahead, 26 m to its left, 2 m behind and 22 m to its right.
    told = rows(AGV, [(1.0, READING, 0, [1.2, 26.0, 1.5, np.nan], 0)])
    beams.draw(told, mean, mean[:2], mean[2], p)
    np.testing.assert_allclose(beams._expected.points[:, 0, :2], [[2.0, 0.5]] * 4, atol=1e-6)
    np.testing.assert_allclose(
        beams._expected.points[:, 1, :2], [[2, 1.5], [-24, 0.5], [2, -1.5], [24, 0.5]], atol=1e-5
    )
    used, refused = beams._dots
    np.testing.assert_allclose(used.points[:, :2], [[2, 1.7], [-24, 0.5], [2, -1.0]], atol=1e-5)
    assert used.visible and not refused.visible
    # From wall to reading: a line as long as the innovation.
    lengths = np.linalg.norm(np.diff(beams._read.points, axis=1)[:, 0], axis=1)
    np.testing.assert_allclose(lengths, [0.2, 0.0, 0.5], atol=1e-5)

    told.column("verdict")[0] = GATED
    beams.draw(told, mean, mean[:2], mean[2], p)
    assert refused.visible and not used.visible
    # A reading says where the vehicle was, not where it is.
    late = rows(AGV, [(1.0, READING, 0, [1.2, 26.0, 1.5, 22.0], 0), (1.1 + MAX_AGE_S, TRUTH, 0, [0.0], 0)])
    beams.draw(late, mean, mean[:2], mean[2], p)
    assert not used.visible and not refused.visible and beams._expected.visible


def test_an_arc_is_as_far_as_its_beacon_reads_on_the_side_of_the_vehicle(server):
    names = {f"range_{k}": (f"anchor_{k}_east", f"anchor_{k}_north") for k in (1, 2, 3)}
    beacons = Beacons(Shapes(server.scene, "/beacons"), ROVER, names, LIGHT, size=1.0)
    tuning = Tuning.of(ROVER).set("p.anchor_2_east", 7.0).set("p.anchor_2_north", -3.0)
    told = rows(
        ROVER,
        [(0.0, READING, 0, [4.0], 0), (FADING_S - 1.0, READING, 1, [5.0], GATED), (FADING_S + 0.5, TRUTH, 0, [0], 0)],
    )
    beacons.draw(told, ROVER.prior_mean, np.array([7.0, 2.0]), tuning.p)
    first, second, third = beacons._arcs
    # The first was heard too long ago, the third never.
    assert [arc.visible for arc in (first, second, third)] == [False, True, False]
    np.testing.assert_allclose(second.position[:2], [7.0, -3.0])
    assert tuple(second.scale)[:2] == (5.0, 5.0)
    points = np.asarray(second.points)[..., :2]
    np.testing.assert_allclose(np.hypot(*points.reshape(-1, 2).T), 1.0, rtol=1e-6)
    # The vehicle is to the north of it.
    np.testing.assert_allclose(second.wxyz, about_z(np.pi / 2), atol=1e-12)
    np.testing.assert_allclose(points.mean(axis=(0, 1))[1], 0.0, atol=1e-6)
    np.testing.assert_allclose(beacons._marks.points[1, :2], [7.0, -3.0])
    # Refused, and somewhat pale.
    assert np.abs(np.subtract(second.colors, LIGHT.refused, dtype=int)).max() < 60


def test_a_vehicle_is_of_its_size_and_an_endless_doubt_has_no_area(server):
    section = SceneSection(kind="vehicle", position=("east", "north"), heading="heading", size=(1.2, 0.7, 0.5))
    scene = VehicleScene(server.scene, AGV, section, LIGHT)
    sent = {message.name: message.props for message in server._websock_server._broadcast_buffer.message_from_id.values()
            if hasattr(message, "props")}  # fmt: skip
    body = sent["/scene/world/vehicle/body"]
    assert tuple(body.dimensions[:2]) == (1.2, 0.7)
    told = rows(AGV, [(0.0, TRUTH, 0, [0.0], 0)])
    for std, seen in ((0.5, True), (1000.0, False)):
        cov = np.diag([std, std, 0.1]) ** 2
        scene.draw(told, SimpleNamespace(mean=np.zeros(3), cov=cov, points=np.zeros((0, 3)), peaks=()))
        assert scene._ellipse.visible == seen and scene._rim.visible
        np.testing.assert_allclose(scene._rim.scale[:2], 2 * std)
    scene.root.remove()


def picture(mean, std):
    return Picture(1, 0, 0, np.nan, np.nan, np.nan, mean.astype(np.float32), std.astype(np.float32), None)


def test_a_surface_is_as_high_as_the_field_and_as_doubtful(server):
    model = MODELS["thermal_field"]
    tall, wide = model.grid.shape
    i, j = np.mgrid[0:tall, 0:wide]
    mean = 20.0 + 10.0 * j / (wide - 1)  # rises to the east, from 20 to 30
    std = np.where(i < tall / 2, 0.5, 1.0)  # the south is in doubt
    scene = FieldSurfaceScene(server.scene, model, LIGHT, "temperature", truth=False)
    scene.update(SimpleNamespace(pictures=[picture(mean, std)]))
    scene.draw(None, None)
    shown = [mesh for mesh in scene._meshes if mesh.visible]
    corners = np.concatenate([np.asarray(mesh.vertices) for mesh in shown])
    # Twenty bands, west to east; their triangles cover all squares between corners, once.
    assert len(shown) == len(scene._meshes)
    count = sum(len(mesh.faces) for mesh in shown)
    assert count == 2 * (len(scene._rows) - 1) * (len(scene._columns) - 1)
    middles = [np.asarray(mesh.vertices)[:, 0].mean() for mesh in shown]
    assert middles == sorted(middles)
    # Height is proportional to the value: 10 °C take the share of the scale that they are.
    slope, offset = np.polyfit(corners[:, 0], corners[:, 2], 1)
    np.testing.assert_allclose(corners[:, 2], slope * corners[:, 0] + offset, atol=1e-5)
    assert 0.5 * SURFACE_HEIGHT < np.ptp(corners[:, 2]) <= SURFACE_HEIGHT
    # Upright lines: 4 std long, in the same unit of height.
    per_degree = np.ptp(corners[:, 2]) / np.ptp(mean[0, scene._columns])
    lines = np.asarray(scene._bars.points)
    lengths = lines[:, 1, 2] - lines[:, 0, 2]
    north = lines[:, 0, 1] > 0.1
    np.testing.assert_allclose(lengths[north], 4 * 0.5 * per_degree, rtol=1e-3)
    np.testing.assert_allclose(lengths[lines[:, 0, 1] < -0.1], 4 * 1.0 * per_degree, rtol=1e-3)
    scene.root.remove()


T = np.arange(10, dtype=np.int64) * 10**9
MEAN = np.column_stack((np.arange(10.0), np.full(10, 5.0)))  # in the middle, where nothing is
PEAK = np.array([3.0, 0.0])


def test_without_several_peaks_it_is_the_mean():
    trail = PeakTrail()
    assert trail.of(T, MEAN) is MEAN
    for n in range(1, 11):
        trail.update(T[:n], MEAN[:n], None)
    np.testing.assert_array_equal(trail.of(T, MEAN), MEAN)


def test_where_there_are_several_it_is_the_heaviest_and_no_row_of_the_mean():
    """Looked at every other row; two peaks at rows 3 and 5, one from row 7 on."""
    trail = PeakTrail()
    for n, peak in ((2, None), (4, PEAK), (6, PEAK + [2, 0]), (8, None)):
        trail.update(T[:n], MEAN[:n], peak)
    expected = [*MEAN[:2], PEAK, PEAK + [2, 0], *MEAN[6:]]
    np.testing.assert_array_equal(trail.of(T, MEAN), expected)
    # Rows that follow the last look are as that was: none of them is drawn where nothing is.
    trail.update(T[:9], MEAN[:9], PEAK + [5, 0])
    np.testing.assert_array_equal(trail.of(T, MEAN), [*expected[:-2], PEAK + [5, 0]])


def test_rows_that_are_others_by_now_had_other_peaks():
    trail = PeakTrail()
    trail.update(T[:4], MEAN[:4], PEAK)
    other = MEAN + 1.0
    trail.update(T[:6], other[:6], None)
    np.testing.assert_array_equal(trail.of(T[:6], other[:6]), other[:6])
    # A source that began again is at an earlier time.
    trail.update(T[:6], other[:6], PEAK)
    trail.update(T[:2], MEAN[:2], None)
    np.testing.assert_array_equal(trail.of(T[:2], MEAN[:2]), MEAN[:2])


def test_looks_that_left_the_history_are_not_drawn():
    trail = PeakTrail()
    trail.update(T[:2], MEAN[:2], PEAK)
    trail.update(T[:6], MEAN[:6], None)
    np.testing.assert_array_equal(trail.of(T[3:6], MEAN[3:6]), MEAN[3:6])
