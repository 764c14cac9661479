"""The gallery in headless Chromium: choose, switch and come back, two browsers in step, recordings, files dropped."""

import base64

import numpy as np
import pytest

from app.cli.arguments import CommissionCommand
from app.cli.commission import commission_twin
from app.engine.commands import Load, Record, SetTuning
from app.record.reader import read_recording
from estimators.track import TRACKING
from tests.app.scripted import pull_all
from tests.app.web.gallery.opened import opened
from tests.app.web.page.browsed import drawn, until
from tests.waiting import wait_for

pytestmark = pytest.mark.browser


def shows(page, twin):
    """A twin's page, with charts that draw."""
    until(page, f"window.nisus?.model?.twin === '{twin}' && window.nisus.drawn > 0")


def card(page, name):
    return page.locator(f"[data-name='{name}']")


def test_two_browsers_start_switch_and_come_back(visit, tmp_path):
    with opened(tmp_path / "recordings") as session:
        first = visit(session.session.url, ready=None)
        second = visit(session.session.url, ready=None, scene=True)
        address = first.url
        for page in (first, second):
            page.get_by_text("How do I know that my filter works?").wait_for()
            until(
                page, "document.querySelectorAll('.picture svg').length === document.querySelectorAll('.card').length"
            )
        # Found by a word of what it teaches, and started.
        first.keyboard.press("/")
        first.keyboard.type("thermometer kalman")
        assert first.locator(".card:visible").count() == 1
        card(first, "motor_winding").get_by_role("button", name="Start").click()
        for page in (first, second):
            shows(page, "motor_winding")
            assert page.url == address
        wait_for(lambda: drawn(first, "#charts")["estimate"] > 200)

        # Back to the gallery while it goes on; the other browser stays where it is.
        first.keyboard.press("g")
        first.get_by_text("motor_winding runs").wait_for()
        assert first.url.endswith("/gallery") and second.url == address
        before = session.engine.status().counts["readings"]
        wait_for(lambda: session.engine.status().counts["readings"] > before)
        card(first, "motor_winding").get_by_role("button", name="Back to").click()
        shows(first, "motor_winding")

        # Another one, by the palette: both are taken along, and the engine of the first is still.
        left = session.engine
        first.locator("#others").click()
        until(first, "window.nisus?.cards > 0")
        first.keyboard.press("Control+k")
        first.keyboard.type("start motor_can")
        first.keyboard.press("Enter")
        for page in (first, second):
            shows(page, "motor_can")
            assert page.url == address
        rows = left.status().counts["readings"]
        wait_for(lambda: drawn(second, "#charts")["reading"] > 30)
        assert left.status().counts["readings"] == rows
        second.frame_locator("#stage").locator("canvas").first.wait_for()

        # What fails is said where it was asked, and what runs goes on.
        until(first, "window.nisus.link.status.twin === 'motor_can'")
        first.evaluate("location.assign('/gallery')")
        first.get_by_role("button", name="Stop").wait_for()
        session.post("/api/gallery/recordings/open", {"name": "gone.rrd"})
        first.get_by_role("button", name="Stop").click()
        for page in (first, second):
            page.get_by_text("How do I know that my filter works?").wait_for()
            wait_for(lambda page=page: page.locator("#now").inner_text() == "")
        assert session.state()["running"] is None


def test_a_twin_that_lacks_its_data_is_grey_and_says_how_to_get_it(visit, tmp_path, monkeypatch):
    monkeypatch.setenv("NISUS_DATA", str(tmp_path))
    with opened(tmp_path / "recordings") as session:
        page = visit(session.session.url, ready=None)
        card(page, "road_car").wait_for()
        assert card(page, "road_car").get_attribute("data-ready") == "false"
        assert card(page, "road_car").get_by_role("button", name="Start").count() == 0
        card(page, "road_car").get_by_text("how to get it").click()
        card(page, "road_car").get_by_text("To get it: nisus data get road_car.").wait_for()


def test_a_mistake_in_a_file_is_on_the_page_until_it_is_mended(visit, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    yaml = tmp_path / "pump.yaml"
    good = (
        "model: motor_winding\nsensors:\n  winding: {variance: 4}\nestimator: kf\n"
        "source: {type: simulator, step: 0.1, sensors: {winding: {every: 1}}}\n"
    )
    yaml.write_text(good)
    with opened(tmp_path / "recordings", yaml) as session:
        page = visit(session.session.url, ready=None)
        shows(page, "pump")
        yaml.write_text(good.replace("variance: 4", "variance: -44"))
        page.locator("#unread").wait_for()
        assert page.locator("#unread").inner_text().startswith("pump.yaml:3: ")
        yaml.write_text(good.replace("variance: 4", "variance: 400"))
        page.locator("#unread").wait_for(state="hidden")
        until(page, "window.nisus.revision === 1")
        field = page.get_by_label("winding, value")
        wait_for(lambda: field.input_value() == "400")
        # That is what is configured now: nothing is turned.
        wait_for(lambda: page.locator("[data-key='R.winding'][data-turned]").count() == 0)
        # Saved with another shape, it is started anew, which the page says.
        yaml.write_text(good.replace("step: 0.1", "step: 0.05"))
        page.get_by_role("tab", name="Episodes").click()
        wait_for(lambda: "started anew" in page.locator("body").inner_text())


DROP = """([name, data, target]) => {
  const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
  const moved = new DataTransfer();
  moved.items.add(new File([bytes], name));
  for (const type of ["dragenter", "dragover", "drop"])
    document.querySelector(target).dispatchEvent(
      new DragEvent(type, {bubbles: true, cancelable: true, dataTransfer: moved}));
}"""


def drop(page, name, data, target="body"):
    page.evaluate(DROP, [name, base64.b64encode(data).decode(), target])


def test_record_review_drop_and_delete(visit, tmp_path):
    folder = tmp_path / "recordings"
    with opened(folder, "motor_winding", speed=1e6) as session:
        page = visit(session.session.url, ready=None)
        shows(page, "motor_winding")
        wait_for(lambda: session.engine.status().finished)
        page.keyboard.press("r")
        until(page, "window.nisus.link.status.recording !== null")
        page.keyboard.press("r")
        wait_for(lambda: session.session.recorder.finished)
        (path,) = folder.glob("motor_winding-*.rrd")
        live = pull_all(session.engine)
        page.keyboard.press("g")
        row = page.locator(f".file[data-name='{path.name}']")
        row.get_by_text("motor_winding · ").wait_for()
        row.get_by_text("RMSE temperature 1.04 °C").wait_for()
        with page.expect_download() as download:
            row.get_by_label(f"Download {path.name}").click()
        assert download.value.path().read_bytes() == path.read_bytes()

        # Open is review: the same page, the same bits.
        row.locator(".name").click()
        until(page, "window.nisus?.link?.status.began_as === 'recorded'")
        wait_for(lambda: session.engine.status().finished)
        np.testing.assert_array_equal(pull_all(session.engine).track.mean, live.track.mean)
        wait_for(lambda: drawn(page, "#charts")["estimate"] > 200)

        # Dropped on a twin's page it is kept under a name of its own, and opens.
        drop(page, path.name, path.read_bytes())
        kept = folder / path.name.replace(".rrd", "-2.rrd")
        wait_for(lambda: session.state()["running"]["title"] == kept.name)
        assert kept.read_bytes() == path.read_bytes() and read_recording(kept).name == "motor_winding"
        until(page, f"window.nisus?.link?.boot === '{session.settled()['boot']}' && window.nisus.drawn > 0")
        drop(page, "broken.rrd", b"RRF2 and no more")
        page.locator("#toast[data-wrong=true]").wait_for()
        assert "broken.rrd" in page.locator("#toast").inner_text()
        assert session.state()["running"]["title"] == kept.name

        # A log opens with its signals; dropped on a card, it is read by that twin.
        page.keyboard.press("g")
        card(page, "motor_winding").wait_for()
        drop(page, "drive.csv", b"t,T\n0,1\n1,3\n2,2\n")
        page.locator(".signal[data-signal=T][data-drawn]").wait_for()
        page.get_by_role("link", name="All twins").click()
        card(page, "motor_bench").wait_for()
        drop(page, "other.csv", b"t,T\n0,1\n", "[data-name=motor_bench] h2")
        page.locator("#failed").wait_for()
        wait_for(lambda: "other.csv" in page.locator("#failed").inner_text())

        # Delete asks first.
        row = page.locator(".file[data-name='drive.csv']")
        row.get_by_label("Delete drive.csv").click()
        page.get_by_role("button", name="Keep").click()
        assert (folder / "drive.csv").exists()
        row.get_by_label("Delete drive.csv").click()
        page.get_by_role("button", name="Delete for good").click()
        row.wait_for(state="detached")
        assert not (folder / "drive.csv").exists() and (folder / "other.csv").exists() and path.exists()


def test_a_link_of_another_twin_offers_to_start_it_and_goes_to_its_moment(visit, tmp_path):
    moment = "#twin=motor_joint&from=1970-01-01T00:00:05Z&span=10"
    with opened(tmp_path / "recordings", "motor_winding") as session:
        page = visit(session.session.url, ready=None)
        shows(page, "motor_winding")
        page.evaluate(f"location.hash = '{moment}'")
        page.locator("#toast").get_by_text("the link is of motor_joint; motor_winding runs here").wait_for()
        page.get_by_role("button", name="Stay with motor_winding").click()
        until(page, "document.getElementById('toast').hidden && location.hash === ''")
        page.evaluate(f"location.hash = '{moment}'")
        page.get_by_role("button", name="Start motor_joint").click()
        shows(page, "motor_joint")
        assert session.settled()["running"]["name"] == "motor_joint"
        until(page, "window.nisus.charts.range[0] === 5 && window.nisus.charts.range[1] === 15")
        # One that is unknown here is no offer.
        page.evaluate("location.hash = '#twin=elsewhere&from=1970-01-01T00:00:05Z&span=10'")
        page.locator("#toast").get_by_text("No twin of that name can be started here").wait_for()
        assert page.locator("#toast button").count() == 0

        # Where nothing runs the gallery has the offer; the name of a card starts it, too.
        session.post("/api/gallery/stop", {})
        until(page, "window.nisus?.cards > 0")
        page.goto(f"{page.url.split('#')[0].rstrip('/')}/gallery{moment}")
        page.get_by_text("The link is of motor_joint: start it to go there").wait_for()
        card(page, "motor_joint").get_by_role("button", name="motor_joint", exact=True).click()
        shows(page, "motor_joint")
        until(page, "window.nisus.charts.range[0] === 5")


def test_what_is_recorded_is_named_in_the_bar(visit, tmp_path):
    with opened(tmp_path / "recordings", "motor_winding") as session:
        page = visit(session.session.url, ready=None)
        shows(page, "motor_winding")
        assert page.locator("#recording").is_hidden()
        session.engine.submit(Record(tmp_path / "evidence.rrd"))
        page.locator("#recording").get_by_text("evidence.rrd").wait_for()
        title = f"Recording evidence.rrd into {tmp_path}"
        assert page.locator("#recording").get_attribute("title") == title
        assert page.locator("#record").get_attribute("title") == f"{title}: end it (R)"
        session.engine.submit(Record(None))
        until(page, "document.getElementById('recording').hidden")


def test_a_twin_of_ones_own_stores_its_baseline(visit, tmp_path, capsys):
    """Measurements with 1.4 times the configured deviation: an alarm, until that is its baseline."""
    y = 40.0 + np.random.default_rng(1).normal(0.0, 2.8, 300)
    (tmp_path / "drive.csv").write_text("t,y\n" + "".join(f"{k},{value:.3f}\n" for k, value in enumerate(y)))
    path = tmp_path / "drive.yaml"
    source = "{type: table, files: drive.csv, time: {column: t, unit: s}, sensors: {winding: {columns: y}}}"
    path.write_text(f"model: motor_winding\nsource: {source}\n")
    with opened(tmp_path / "recordings", path, speed=float("inf")) as session:
        page = visit(session.session.url, ready=None)
        shows(page, "drive")
        wait_for(lambda: session.engine.status().finished)
        # An edit is not in the file, so its baseline would be another tuning's.
        session.engine.submit(SetTuning("Q.rate", 0.02))
        wait_for(lambda: session.engine.folded_with()[0].get("Q.rate") == 0.02)
        page.get_by_role("tab", name="Episodes").click()
        section = page.get_by_role("region", name="Baseline")
        section.get_by_role("button", name="Store baseline").click()
        section.get_by_text("has been edited; save it first").wait_for()
        beside = path.with_name("drive.baseline.yaml")
        assert not beside.exists()
        session.engine.submit(Load(0))
        wait_for(lambda: session.engine.folded_with()[0].get("Q.rate") != 0.02)
        section.get_by_role("button", name="Store baseline").click()
        wait_for(lambda: session.engine.folded_with()[0].baseline is not None)
        # What `nisus commission` prints for the file.
        stored = beside.read_text()
        assert commission_twin(CommissionCommand(str(path))) == 0
        assert capsys.readouterr().out.endswith(stored) and "scale: 1.275" in stored
        section.get_by_text("Stored in drive.baseline.yaml").wait_for()
        assert section.get_by_role("button").count() == 0
        wait_for(lambda: session.engine.status().health == TRACKING)


def test_a_bundled_twin_has_no_baseline_to_store(visit, tmp_path):
    with opened(tmp_path / "recordings", "motor_winding") as session:
        page = visit(session.session.url, ready=None)
        shows(page, "motor_winding")
        page.get_by_role("tab", name="Episodes").click()
        assert page.locator(".why").is_visible() and page.locator(".baseline").is_hidden()
