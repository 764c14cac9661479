"""The gallery over HTTP: cards, one twin after another behind one port, failed starts."""

import gc
import json
import socket
import threading
import weakref

import pytest
from websockets.sync.client import connect

import app.web.gallery.api
from app.cli.open_twin import FileOpener
from config.loader import shipped
from estimators.errors import ConfigError
from tests.app.web.gallery.opened import opened
from tests.waiting import LIMIT_S, wait_for

RECORDED = {
    "battery_dmegc", "battery_panasonic", "field_era5", "motor_bench", "motor_bench_hybrid", "motor_bench_joint",
    "road_car", "road_car_rav4", "uwb_rover_labyrinth", "uwb_rover_plaza",
}  # fmt: skip
"""The twins whose recordings do not ship."""


@pytest.fixture(scope="module")
def empty(tmp_path_factory):
    """`nisus run` without a name."""
    with opened(tmp_path_factory.mktemp("recordings")) as session:
        yield session


def stream(session):
    client = session.client
    return connect(
        f"ws://{client.host}/api/stream", origin=client.origin, additional_headers={"Cookie": client.cookie},
        proxy=None, open_timeout=LIMIT_S, compression=None,
    )  # fmt: skip


def told(session):
    """The first word of a page's stream."""
    with stream(session) as socket_:
        return json.loads(socket_.recv(LIMIT_S))


def test_every_twin_that_ships_has_its_card(empty):
    cards = {card["name"]: card for card in empty.get("/api/gallery")}
    assert set(cards) == set(shipped())
    for card in cards.values():
        assert card["question"].endswith("?") and card["teaches"].endswith("."), card["name"]
        assert card["picture"] and card["error"] is None
    assert cards["motor_winding"]["states"] == 2 and cards["thermal_field"]["states"] == 200 * 200


def test_a_twin_without_its_data_says_what_it_needs(empty, tmp_path, monkeypatch):
    monkeypatch.setenv("NISUS_DATA", str(tmp_path))
    cards = {card["name"]: card for card in empty.get("/api/gallery")}
    assert {name for name, card in cards.items() if card["missing"]} == RECORDED
    assert "set NISUS_DATA" in cards["road_car"]["missing"] and cards["road_car"]["missing"].endswith(
        "; to get it: nisus data get road_car"
    )
    state = empty.start("battery_dmegc")
    assert state["running"] is None and "set NISUS_DATA" in state["failed"]["text"]


def test_a_picture_is_an_image_of_the_twin(empty):
    answer = empty.client.get("/api/gallery/picture?twin=motor_winding")
    assert answer.status == 200 and answer.headers["content-type"].startswith("image/svg+xml")
    assert b"<script" not in answer.body and answer.body.startswith(b"<svg")
    for name in ("../twins/motor_winding", "nothing", ""):
        assert empty.client.get(f"/api/gallery/picture?twin={name}").status == 404


@pytest.mark.parametrize("name", ["../../etc/passwd", "/tmp/mine.yaml", "motor", "", None, 3])
def test_only_what_is_on_the_shelf_can_be_started(empty, name):
    status, answer = empty.post("/api/gallery/start", {"twin": name})
    assert status == 400 and "\n" not in answer["error"]
    assert empty.state()["running"] is None


@pytest.mark.parametrize("path", ["start", "stop", "recordings/open", "recordings/delete", "recordings/drop"])
def test_strangers_change_nothing(empty, path):
    path, client, body = f"/api/gallery/{path}", empty.client, b'{"twin": "motor_winding"}'
    kind = ("Content-Type", "application/json")
    without = client.raw("POST", path, [("Host", client.host), ("Origin", client.origin), kind], body)
    foreign = [("Host", client.host), ("Cookie", client.cookie), ("Origin", "http://evil.example"), kind]
    assert without.status == 403 and client.raw("POST", path, foreign, body).status == 403
    for target in ("/gallery", "/api/session", "/api/gallery", "/recordings/a.rrd"):
        assert client.raw("GET", target, [("Host", client.host)]).status == 403


def test_the_page_is_the_gallery_until_a_twin_runs(empty):
    assert b"Gallery" in empty.client.get("/").body
    status, answer = empty.post("/api/command", {"command": "Reset"})
    assert status == 409 and "choose one" in answer["error"]
    assert told(empty) == {"boot": empty.state()["boot"]}


def test_a_twin_that_is_started_says_that_its_model_is_compiled(tmp_path, monkeypatch):
    begun, go = threading.Event(), threading.Event()

    def made_ready(self, opening):
        begun.set()
        go.wait(LIMIT_S)
        raise ConfigError("enough")

    monkeypatch.setattr(FileOpener, "made_ready", made_ready)
    with opened(tmp_path) as session:
        monkeypatch.setattr(app.web.gallery.api, "COMPILING_SHOWN_AFTER_S", 0.0)
        assert session.post("/api/gallery/start", {"twin": "motor_winding"})[0] == 202
        begun.wait(LIMIT_S)
        starting = session.state()["starting"]
        assert starting["name"] == "motor_winding" and starting["doing"] == "compiling"
        monkeypatch.setattr(
            app.web.gallery.api, "COMPILING_SHOWN_AFTER_S", LIMIT_S
        )  # what takes no longer is loaded from the cache
        assert session.state()["starting"]["doing"] == ""
        go.set()
        assert session.settled()["failed"] == {"title": "motor_winding", "text": "enough"}


def test_a_gallery_in_place_of_a_twin_that_came_since_reloads(tmp_path):
    with opened(tmp_path) as session:
        boot = session.state()["boot"]
        assert session.session.http_server.boot_without_twin == boot and boot in session.client.get("/").text
        session.start("motor_winding")
        assert session.session.http_server.boot_without_twin == ""


def test_one_twin_after_another_behind_one_port(tmp_path):
    with opened(tmp_path) as session:
        url, boots = session.session.url, [session.state()["boot"]]
        # What a process keeps for good (a pool of the server, a compiler's) is there after the first.
        assert session.start("motor_winding")["running"]["name"] == "motor_winding"
        session.post("/api/gallery/stop", {})
        threads = {thread.name for thread in threading.enumerate() if thread.name != "MainThread"}
        for name in ("motor_winding", "motor_can", "motor_winding"):
            page = None if session.state()["running"] is None else stream(session)
            before = None if page is None else (weakref.ref(session.engine), session.session.running.view.port)
            state = session.start(name)
            assert state["failed"] is None and state["running"]["name"] == name
            boots.append(state["boot"])
            assert session.get("/api/status")["twin"] == name and session.get("/api/model")["twin"] == name
            wait_for(lambda: session.engine.status().counts.get("readings", 0) > 3)
            if page is not None and before is not None:
                # The page of the twin before is let go of, and finds another one.
                with pytest.raises(Exception, match=r"1012|1000|1005"):
                    wait_for(lambda page=page: not page.recv(LIMIT_S))
                assert told(session)["boot"] == state["boot"]
                with pytest.raises(OSError):
                    socket.create_connection(("127.0.0.1", before[1]), timeout=LIMIT_S)
                gone = before[0]
                wait_for(lambda gone=gone: gc.collect() >= 0 and gone() is None)
        assert len(set(boots)) == len(boots) and session.session.url == url
        session.post("/api/gallery/stop", {})
        assert session.state()["running"] is None and b"Gallery" in session.client.get("/").body

        def left():
            names = {thread.name for thread in threading.enumerate() if thread.name != "MainThread"}
            return {name for name in names - threads if not name.startswith(("AnyIO", "asyncio"))}

        wait_for(lambda: not left())


def test_a_bus_is_left_before_another_twin_listens_to_it(tmp_path):
    """Else it would hear the asset of the one before. What is read in its own time goes on until the next is ready."""
    with opened(tmp_path, "motor_can") as session:
        put_together, read = session.session.prepared, []

        def prepared(opening):
            read.append("source" in {thread.name for thread in threading.enumerate()})
            return put_together(opening)

        session.session.prepared = prepared
        for name in ("motor_can", "motor_winding", "motor_can"):
            assert session.start(name)["running"]["name"] == name
        assert read == [False, True, True]


def test_what_ran_goes_on_when_another_one_fails(tmp_path):
    bad = tmp_path / "bad.yaml"
    good = "model: motor_winding\nestimator: kf\nsource: {type: simulator, step: 0.1, sensors: {winding: {every: 1}}}\n"
    bad.write_text(good)
    with opened(tmp_path / "recordings", bad) as session:
        assert session.get("/api/gallery")[0]["name"] == str(bad)
        session.start("motor_winding")
        engine = session.engine
        bad.write_text(good.replace("kf", "sharp"))
        assert "sharp" in session.get("/api/gallery")[0]["error"]
        state = session.start(str(bad))
        assert state["failed"]["title"] == "bad" and "bad.yaml:2: " in state["failed"]["text"]
        assert state["running"]["name"] == "motor_winding" and session.engine is engine
        before = engine.status().counts["readings"]
        wait_for(lambda: engine.status().counts["readings"] > before)
        bad.write_text(good)
        state = session.start(str(bad))
        assert state["failed"] is None and state["running"]["name"] == str(bad)
