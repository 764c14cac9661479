"""Viser against an engine without threads: who may connect, and what is drawn."""

import asyncio
import base64
import http.client
import os
import socket
import threading
from contextlib import ExitStack
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import viser
import websockets
from viser import _messages

from app.charts.colors import LIGHT
from app.scene.guarded_server import HEADER, addresses, guarded_server
from app.scene.scene import History
from app.scene.vehicle_scene import VehicleScene
from app.scene.view import EDIT_REST_S, ViserView
from config.schema import SceneSection, ViewSection
from estimators.log import READING, TRUTH, Events
from estimators.models import MODELS
from estimators.numerics.peaks import Peak
from tests.app.scripted import events, viewed
from tests.models import first_states
from tests.waiting import LIMIT_S, wait_for

WINDING = MODELS["motor_winding"]


def history(n=60, seed=0):
    rng = np.random.default_rng(seed)
    t = 1.0 + np.arange(n)
    truth = 40.0 + 0.1 * t
    parts = [events(WINDING, READING, 0, t, truth + rng.normal(0, 2, n)), events(WINDING, TRUTH, 0, t, truth)]
    both = Events.concat(parts, WINDING.width)
    return both.select(np.argsort(both.t, kind="stable"))


@pytest.fixture
def engine():
    engine = viewed(WINDING)
    engine.put(history())
    return engine


@pytest.fixture
def framed():
    """Makes views that have drawn one frame."""
    with ExitStack() as ends:

        def frame(engine):
            view = ViserView(engine, secret="s3cret")
            ends.callback(view.stop)
            view.frame()
            return view

        yield frame


@pytest.fixture
def view(engine, framed):
    return framed(engine)


# Who may connect


@pytest.fixture(scope="module")
def guarded():
    server = guarded_server("s3cret", "test")
    yield server
    server.stop()


def get(port, path="/", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=LIMIT_S)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    body = response.read()
    connection.close()
    return response.status, body


def test_page_needs_the_secret(guarded):
    port = guarded.get_port()
    status, body = get(port, **{HEADER: "s3cret"})
    assert status == 200 and b"<html" in body.lower()
    for headers in ({}, {HEADER: ""}, {HEADER: "s3cre"}, {HEADER: "s3crets"}, {HEADER: "S3CRET"}):
        assert get(port, **headers)[0] == 403


def test_upgrade_without_the_secret_is_refused_on_the_wire(guarded):
    """A raw socket: neither a missing header nor a header given twice opens a WebSocket."""
    key = base64.b64encode(os.urandom(16)).decode()
    for extra in ("", f"{HEADER}: wrong\r\n", f"{HEADER}: s3cret\r\n{HEADER}: wrong\r\n"):
        with socket.create_connection(("127.0.0.1", guarded.get_port()), timeout=LIMIT_S) as raw:
            raw.sendall(
                f"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n{extra}"
                f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
                f"Sec-WebSocket-Protocol: viser-v{viser.__version__}\r\n\r\n".encode()
            )
            assert raw.recv(64).startswith(b"HTTP/1.1 403")


def test_serve_is_restored_and_the_tunnel_gone(guarded):
    assert websockets.asyncio.server.serve.__module__.startswith("websockets")
    assert _messages.ShareUrlRequest not in guarded._websock_server._incoming_handlers
    with socket.create_connection(("127.0.0.1", guarded.get_port())) as raw:
        assert raw.getpeername()[0] == "127.0.0.1"


# What is drawn


def test_the_scene_waits_until_a_knob_rests_but_not_for_ever(view, engine):
    view._drawn = 100.0
    assert not view._waits(100.0)
    engine.tuning = engine.tuning.set("R.winding", 2.0)
    assert view._waits(100.1) and view._waits(100.0 + 0.9 * EDIT_REST_S)
    assert not view._waits(100.1 + EDIT_REST_S)
    # A drag: something new ten times a second.
    turned = []
    for k in range(1, 30):
        engine.tuning = engine.tuning.set("R.winding", 2.0 + k)
        turned.append(view._waits(101.0 + 0.1 * k))
        if not turned[-1]:
            view._drawn = 101.0 + 0.1 * k
    assert 2 <= turned.count(False) <= 4


def test_nobody_there_nothing_pulled(engine, monkeypatch):
    """Until a browser connects, and again when it has gone; it sees the newest rows at once."""
    pulled, released = [], []
    pull = engine.pull
    monkeypatch.setattr(engine, "pull", lambda *given, **more: pulled.append(1) or pull(*given, **more))
    monkeypatch.setattr(engine, "release", lambda cursor: released.append(1))
    view = ViserView(engine, secret="s3cret")
    connected, leave, gone = threading.Event(), threading.Event(), threading.Event()

    async def browse():
        async with websockets.connect(
            f"ws://127.0.0.1:{view.port}/?theme=dark",
            additional_headers={HEADER: "s3cret"},
            subprotocols=[f"viser-v{viser.__version__}"],
            compression=None,
        ) as connection:
            await connection.recv()
            connected.set()
            await asyncio.to_thread(leave.wait)
        gone.set()

    try:
        view.start()
        wait_for(lambda: view._thread.is_alive())
        assert addresses(view.server) == [] and pulled == [] and view.history.n == 0
        browser = threading.Thread(target=lambda: asyncio.run(browse()))
        browser.start()
        assert connected.wait(LIMIT_S)
        wait_for(lambda: view.history.n == engine._log.n)
        assert addresses(view.server) == ["theme=dark"] and pulled
        leave.set()
        assert gone.wait(LIMIT_S)
        browser.join(LIMIT_S)
        wait_for(lambda: view._cursor is None)
        count = len(pulled)
        engine.put(events(WINDING, READING, 0, [100.0], [45.0]))
        assert len(pulled) == count and released and view.history.n == 0
    finally:
        leave.set()
        view.stop()


def test_nothing_new_is_not_drawn_again(view, engine):
    sent = []
    view.server._websock_server.queue_message = sent.append
    view.frame()
    assert sent == []


def test_belief_scene_follows_the_estimate(view, engine):
    belief = engine.belief()
    axes = view.renderer.scene.axes
    place = [axis.place(belief.mean[axis.state]) for axis in axes]
    np.testing.assert_allclose(view.renderer.scene._belief.position[:2], place, atol=1e-6)
    assert np.all(np.abs(place) < 1.0)
    labels = [float(label.text) for label in view.renderer.scene._labels[0]]
    assert labels[0] < belief.mean[0] < labels[-1]


def test_blocks_of_true_states_are_drawn(engine, framed):
    """Both states in one event, the second not always known: the belief's point gets the last of each."""
    t = 100.0 + np.arange(5)
    block = np.stack((50.0 + t, [0.1, np.nan, 0.3, 0.4, np.nan]), axis=1)
    engine.put(events(WINDING, TRUTH, 0, t, block))
    view = framed(engine)
    np.testing.assert_array_equal(view.renderer.scene._true_point(view.history, [1, 0]), [[0.4, 154.0]])


def test_peaks_are_marked_with_their_weights_while_there_are_several(view, engine):
    belief = engine.belief()
    std = np.sqrt(np.diag(belief.cov))
    peaks = tuple(Peak(weight, belief.mean + side * std, belief.cov) for weight, side in ((0.75, 0.5), (0.25, -0.5)))
    view.renderer.scene.draw(view.history, replace(belief, peaks=peaks))
    (first, heavy), (second, light), (third, _) = view.renderer.scene._marks.handles[:3]
    assert first.visible and second.visible and not third.visible
    assert (heavy.text, light.text) == ("75 %", "25 %")
    place = [axis.place(peaks[1].mean[axis.state]) for axis in view.renderer.scene.axes]
    np.testing.assert_allclose(second.points[0, : len(place)], place[:3], atol=0.05)
    view.renderer.scene.draw(view.history, belief)
    assert not (first.visible or second.visible)


def test_vehicle_scene_stands_at_the_heaviest_peak_among_its_walls(server):
    walls = (((-5.0, -1.0), (5.0, -1.0), (5.0, 1.0)),)
    section = SceneSection(kind="vehicle", position=("east", "north"), heading="heading", walls=walls)
    scene = VehicleScene(server.scene, MODELS["agv_corridor"], section, LIGHT)
    peaks = (Peak(0.7, np.array([4.0, 0.5, 0.0]), 0.01 * np.eye(3)), Peak(0.3, -np.ones(3), 0.01 * np.eye(3)))
    cloud = np.array([[4.0, 0.5, 0.0], [-1.0, -1.0, -1.0], [np.nan, 0.0, 0.0]])
    belief = SimpleNamespace(mean=np.array([2.5, 0.0, -0.3]), cov=np.eye(3), points=cloud, peaks=peaks)
    rows = History(3, 4, 16)
    rows.n = 1
    scene.draw(rows, belief)
    assert tuple(scene._vehicle.position[:2]) == (4.0, 0.5)
    assert scene._cloud.visible and scene._cloud.points.shape == (2, 3)
    assert [label.text for _, label in scene._marks.handles if label.visible] == ["70 % drawn", "30 %"]
    scene.draw(rows, SimpleNamespace(**{**vars(belief), "peaks": peaks[:1]}))
    assert tuple(scene._vehicle.position[:2]) == (2.5, 0.0)
    assert not any(label.visible for _, label in scene._marks.handles)
    scene.root.remove()


def test_the_first_view_holds_all_walls_and_stays_until_it_is_to_follow(server):
    walls = (((80.0, -3.0), (140.0, -3.0), (140.0, 45.0)), ((90.0, 0.0), (80.0, 1.0)))
    section = SceneSection(kind="vehicle", position=("east", "north"), heading="heading", walls=walls)
    scene = VehicleScene(server.scene, MODELS["agv_corridor"], section, LIGHT)
    np.testing.assert_allclose(scene.world.position, [-110.0, -21.0, 0.0])
    # What a camera is to see are the walls, about their middle (test_numbers.py: it then sees them).
    corners = scene.outlook.points[:5, :2] - scene.world.position[:2]
    np.testing.assert_allclose(corners, [corner for line in walls for corner in line])
    rows = History(3, 4, 16)
    rows.n = 1
    cov = 0.01 * np.eye(3)
    belief = SimpleNamespace(mean=np.array([135.0, 1.0, 0.0]), cov=cov, points=np.zeros((0, 3)), peaks=())
    scene.draw(rows, belief)
    np.testing.assert_allclose(scene.world.position, [-110.0, -21.0, 0.0])
    scene.follow = True
    for _ in range(40):
        scene.draw(rows, belief)
    np.testing.assert_allclose(scene.world.position, [-135.0, -1.0, 0.0], atol=0.01)
    scene.follow = False
    for _ in range(40):
        scene.draw(rows, belief)
    np.testing.assert_allclose(scene.world.position, [-110.0, -21.0, 0.0], atol=0.01)
    scene.root.remove()


def test_vehicle_scene_keeps_the_vehicle_in_the_middle(framed):
    def f(x, u, p, dt, out):
        out[0] = x[0] + dt * x[2]
        out[1] = x[1]
        out[2] = x[2]

    from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel

    model = StateSpaceModel(
        name="sled", title="Sled", f=f, linear=True,
        states=(State("east", "m", 0, 10), State("north", "m", 0, 10), State("speed", "m/s", 0, 5)),
        noises=(Noise("speed", "(m/s)²/s", 0.1),),
        sensors=(Sensor("gnss", (Row("east", "m", 1.0), Row("north", "m", 1.0)), first_states),),
    )  # fmt: skip
    engine = viewed(model, view=ViewSection(scene=SceneSection(kind="vehicle", position=("east", "north"))))
    t = np.arange(1.0, 61.0)
    engine.put(events(model, READING, 0, t, np.stack((10 * t, 0 * t), axis=1)))
    north = np.where(t == 30.0, np.nan, 3.0)
    engine.put(events(model, TRUTH, 0, t, np.stack((10 * t, north), axis=1)))
    view = framed(engine)
    np.testing.assert_allclose(view.renderer.scene.world.position, [-600.0, 0.0, 0.0], atol=2.0)
    np.testing.assert_allclose(view.renderer.scene._vehicle.position[:2], engine.belief().mean[:2], atol=1e-6)
    assert view.renderer.scene._readings.points.shape == (60, 3)
    way = np.unique(np.asarray(view.renderer.scene._truth.points).reshape(-1, 3), axis=0)
    np.testing.assert_allclose(way[:, 0], 10 * t[t != 30.0], err_msg="where both true states are known")
    np.testing.assert_allclose(way[:, 1], 3.0)
    assert view.renderer.scene._course == pytest.approx(0.0, abs=0.05)
    cov = engine.belief().cov[:2, :2]
    np.testing.assert_allclose(view.renderer.scene._ellipse.scale[:2], 2 * np.sqrt(np.linalg.eigvalsh(cov)), rtol=1e-6)
