"""*Get recording* on the cards of the gallery: over HTTP, and in Chromium."""

import threading

import pytest

from tests.app.web.gallery.opened import opened
from tests.extensions.data.origin import LABYRINTH, offer
from tests.waiting import wait_for

NAME, TWIN = "agv_uwb_labyrinth", "uwb_rover_labyrinth"


@pytest.fixture
def gallery(monkeypatch, tmp_path, origin):
    """A session without a twin, whose recording of one twin comes from the local server."""
    offer(monkeypatch, tmp_path / "here", origin, origin.address, NAME, LABYRINTH)
    with opened(tmp_path / "recordings") as session:
        yield session


def finished(gallery):
    wait_for(lambda: gallery.get("/api/gallery/data")["job"]["state"] != "running")
    return gallery.get("/api/gallery/data")["job"]


def missing(gallery):
    return {card["name"]: card["missing"] for card in gallery.get("/api/gallery")}[TWIN]


def test_a_recording_is_downloaded_in_a_job(gallery, origin):
    found = gallery.get("/api/gallery/data")
    known = {one["name"]: one for one in found["recordings"]}
    size = sum(map(len, LABYRINTH.values()))
    assert found["job"] is None and known[NAME]["bytes"] == size and known[NAME]["host"] in origin.address
    assert known[NAME]["licence"] == "CC BY-SA 4.0" and not known[NAME]["present"]
    assert missing(gallery).endswith(f"nisus data get {TWIN}") and origin.asked == []
    origin.wait = threading.Event()
    status, answer = gallery.post("/api/gallery/data/get", {"name": NAME})
    assert status == 202 and answer["job"]["state"] == "running"
    status, answer = gallery.post("/api/gallery/data/get", {"name": NAME})
    assert status == 400 and answer["error"] == f"{NAME} is being downloaded; wait for it"
    origin.wait.set()
    assert finished(gallery)["state"] == "done" and missing(gallery) is None


def test_what_is_not_downloaded_is_one_line(gallery, origin):
    for name, text in (("motor_bench", "--file"), ("nothing", "has this name"), (None, "")):
        status, answer = gallery.post("/api/gallery/data/get", {"name": name})
        assert status == 400 and text in answer["error"] and "\n" not in answer["error"]
    origin.status = 404
    gallery.post("/api/gallery/data/get", {"name": TWIN})
    job = finished(gallery)
    assert job["state"] == "failed" and "404 Client Error: Not Found; try again" in job["error"]
    assert missing(gallery) is not None


def test_strangers_download_nothing(gallery, origin):
    client, body = gallery.client, b'{"name": "agv_uwb_labyrinth"}'
    kind = ("Content-Type", "application/json")
    for headers in ([("Host", client.host), ("Origin", client.origin), kind], [("Host", "evil.example"), kind]):
        assert client.raw("POST", "/api/gallery/data/get", headers, body).status == 403
    assert origin.asked == []


@pytest.mark.browser
def test_a_card_gets_its_recording_after_a_second_click(visit, gallery, origin):
    page = visit(gallery.session.url, ready=None)
    card, bench = (page.locator(f"[data-name='{name}']") for name in (TWIN, "motor_bench"))
    card.get_by_role("button", name="Get recording").click()
    size = sum(map(len, LABYRINTH.values())) / 1e3
    host = origin.address.removeprefix("http://")
    card.get_by_text(f"From {host}: {size:.0f} kB, licence CC BY-SA 4.0.").wait_for()
    card.get_by_role("button", name="Not now").click()
    assert card.get_by_role("button").count() == 1 and origin.asked == []

    # An error stays on the card, and the next attempt goes on.
    origin.cuts = [5000] * 4
    card.get_by_role("button", name="Get recording").click()
    card.get_by_role("button", name="Download").click()
    card.get_by_text("try again to continue the download").wait_for()
    origin.wait = threading.Event()
    card.get_by_role("button", name="Get recording").click()
    card.get_by_role("button", name="Download").click()
    card.get_by_text("Downloading: ").wait_for()
    assert card.get_by_role("button").count() == 0
    origin.wait.set()
    card.get_by_role("button", name=f"Start {TWIN}").wait_for()
    assert card.get_by_role("button", name=f"Start {TWIN}").evaluate("node => node === document.activeElement")
    assert card.get_attribute("data-ready") == "true" and card.get_by_role("button", name="Get recording").count() == 0

    # What Nisus does not download has its source, and what to type.
    bench.get_by_role("button", name="Get recording").click()
    bench.get_by_text("nisus data get motor_bench --file measures_v2.csv").first.wait_for()
    assert bench.get_by_role("link").get_attribute("href").startswith("https://www.kaggle.com/")
    assert bench.get_by_role("button", name="Download").count() == 0
