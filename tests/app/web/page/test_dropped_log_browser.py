"""A log dropped on the gallery: its signals drawn, the twins that fit, a draft with roles, and the drafted twin.

Figures on the page are compared with the files as read by csv, NumPy, SciPy, asammdf, or by hand from the text.
"""

import gzip
import json
import re
import subprocess
import sys

import can
import numpy as np
import pytest

from estimators.track import HELD_OUT, USED
from tests.app.scripted import pull_all
from tests.app.web.gallery.opened import opened
from tests.app.web.page.browsed import until
from tests.app.web.page.test_gallery_browser import drop
from tests.sources.can.can_tools import dbc
from tests.waiting import wait_for

pytestmark = pytest.mark.browser


BY_ASAMMDF = """
import json, sys, asammdf, numpy
file = asammdf.MDF(sys.argv[1])
decoded = file.extract_bus_logging({"CAN": [(sys.argv[2], 2)]})
speed, valid = decoded.get("Speed"), decoded.get("SpeedValid", raw=True)
times = numpy.concatenate([file.get_master(k) for k in range(len(file.groups))])
begins = (speed.timestamps[0] - times.min()) / numpy.ptp(times)
print(json.dumps([speed.samples.tolist(), valid.samples.tolist(), begins]))
"""
"""Speed of the GNSS receiver in an MF4 file, its flag of validity, and the part of the log before it."""

WHEEL = re.compile(r"\((\S+)\) can0 0AA#(....)(....)")


def wheel_speeds(path):
    """Return the speeds of both front wheels, km/h, from the text of a candump: 15 bits, 0.01 km/h, offset -67.67."""
    pairs = [(int(a, 16) & 0x7FFF, int(b, 16) & 0x7FFF) for _, a, b in WHEEL.findall(path.read_text())]
    return np.array(pairs) * 0.01 - 67.67


def row(page, signal):
    return page.locator(f".signal[data-signal='{signal}']")


def visit_log(visit, session, *files):
    """Drop files on the gallery; return the page once the signals of the last are drawn."""
    page = visit(session.session.url, ready=None)
    page.locator(".card").first.wait_for()
    for path in files:
        drop(page, path.name, path.read_bytes())
        if path.suffix == ".dbc":
            page.get_by_text(f"{path.name} is kept").wait_for()
    return page


def drawn_range(page, signal, begins=0.0):
    """Return what the scale of a quick chart says, highest and lowest; the curve must fill it.

    `begins` is the part of the log before the signal's first value.
    """
    item = row(page, signal)
    item.scroll_into_view_if_needed()
    page.locator(f".signal[data-signal='{signal}'][data-drawn]").wait_for()
    box = item.locator("path.curve").evaluate(
        "(path) => { const b = path.getBBox(); return [b.x, b.width, b.height]; }"
    )
    # From the first sample to the last over the whole width, and from 3 % to 97 % of the height.
    assert box[0] == pytest.approx(1000 * begins, abs=10) and box[0] + box[1] == pytest.approx(1000, abs=10)
    assert box[2] == pytest.approx(94.0, abs=0.2)
    high, low = item.locator(".levels span").all_inner_texts()
    return float(high), float(low)


def assign(page, **roles):
    """Give these signals their roles, and none to all others that the draft proposes."""
    page.locator(".signal-link").first.wait_for()

    def others_without_role():
        names = [name for name in page.locator(".signal-link").all_inner_texts() if name not in roles]
        for name in names[:1]:
            page.get_by_role("searchbox", name="Find a signal").fill(name)
            page.get_by_label(f"Role of {name}", exact=True).select_option("")
        return not names

    wait_for(others_without_role)
    for name, role in roles.items():
        page.get_by_role("searchbox", name="Find a signal").fill(name)
        page.get_by_label(f"Role of {name}", exact=True).select_option(role)


def drafted(page, session, name):
    """Draft a twin, follow it to its page, and return all rows of its run."""
    page.get_by_label("Name of the twin").fill(name)
    page.get_by_role("button", name="Draft and run").click()
    progress = "/api/gallery/log/draft"
    wait_for(lambda: session.get(progress)["state"] not in ("none", "running"))
    assert session.get(progress)["error"] is None and "95 % bounds" in session.get(progress)["summary"]
    until(page, f"window.nisus?.model?.twin === '{name}' && window.nisus.drawn > 0")
    wait_for(lambda: session.engine.status().finished)
    return pull_all(session.engine)


def rows_of(pull, model, sensor):
    """Return values, means of the first state and verdicts at the measurements of a sensor."""
    index = [item.name for item in model.sensors].index(sensor)
    at = pull.events.of_sensor(index)
    return pull.events.value[at, 0], pull.track.mean[at], pull.track.verdict[at]


def test_candump_needs_its_dbc(visit, tmp_path, data):
    log = tmp_path / "rav4.log"
    lines = data("can_comma2k19_rav4", "rav4_2018-08-02_seg40_bus0.log").read_text().splitlines(keepends=True)
    log.write_text("".join(lines[:9000]))
    database = data("can_comma2k19_rav4", "dbc", "toyota_2017.dbc")
    speeds = wheel_speeds(log)
    with opened(tmp_path / "recordings") as session:
        page = visit_log(visit, session, log)
        needs = page.locator(".needs[data-needed=true]")
        needs.get_by_text("This CAN log needs a DBC").wait_for()
        assert "9,000 frames" in needs.inner_text() and page.locator(".frames tbody tr").count() == 90
        # The twin that knows these frames is first, and others say why they do not fit.
        fits = page.locator(".fits li").all()
        assert [item.get_attribute("data-twin") for item in fits] == ["road_car_rav4"]
        page.get_by_text("Why 19 other twins do not").click()
        assert "none of its messages is in the log" in page.locator("details[data-twin=motor_can]").inner_text()
        drop(page, database.name, database.read_bytes())
        row(page, "WHEEL_SPEED_FR").wait_for()
        facts = row(page, "WHEEL_SPEED_FR").inner_text()
        period = np.median(np.diff([float(t) for t, _, _ in WHEEL.findall(log.read_text())]))
        assert "[km/h]" in facts and f"{len(speeds):,} values · {1.0 / period:.1f} Hz" in facts
        assert drawn_range(page, "WHEEL_SPEED_FR") == pytest.approx((speeds[:, 0].max(), speeds[:, 0].min()), abs=0.05)


def test_csv_becomes_a_twin_with_the_roles_that_it_is_given(visit, tmp_path):
    rng = np.random.default_rng(3)
    level = np.round(20.0 + np.cumsum(rng.normal(0.0, 0.3, 300)), 3)
    again, heater = np.round(level + rng.normal(0.0, 0.1, 300), 3), np.round(rng.normal(0.0, 1.0, 300), 3)
    log = tmp_path / "tank.csv"
    rows = zip(range(300), level, again, heater, strict=True)
    log.write_text("t,level,again,heater\n" + "".join(f"{3600 * t},{a},{b},{c}\n" for t, a, b, c in rows))
    with opened(tmp_path / "recordings") as session:
        page = visit_log(visit, session, log)
        assert drawn_range(page, "level") == pytest.approx((level.max(), level.min()), abs=0.05)
        assert "300 values · every 60 min" in row(page, "level").inner_text()
        page.get_by_text("No twin here fits this log").wait_for()
        assign(page, level="state", again="held out", heater="input")
        pull = drafted(page, session, "tank")
        model = session.engine.model
        read, means, verdicts = rows_of(pull, model, "level")
        np.testing.assert_array_equal(read, level)
        assert np.all(verdicts == USED) and [item.name for item in model.inputs] == ["heater"]
        read, _, verdicts = rows_of(pull, model, "again")
        np.testing.assert_array_equal(read, again)
        assert np.all(verdicts == HELD_OUT)
        # Nearly all of the changes from one row to the next are the tank's, and a third of a row's error is left.
        assert np.std(means[:, 0] - level) < np.std(np.diff(level))
        # Back in the gallery it is a twin of one's own, and the log is where it was.
        page.keyboard.press("g")
        page.locator(".card[data-runs=true] h2").get_by_text("tank").wait_for()
        page.locator(f".file[data-name='{log.name}']").wait_for()


def test_mat_of_a_battery_fits_the_twin_of_its_cell(visit, tmp_path, data):
    from scipy.io import loadmat, savemat

    [[whole]] = loadmat(data("battery_panasonic_18650pf", "25degC_US06.mat"))["meas"]
    log = tmp_path / "US06.mat"
    savemat(log, {"meas": {name: whole[name][:6000] for name in whole.dtype.names}})
    meas = loadmat(log, squeeze_me=True, struct_as_record=False)["meas"]
    with opened(tmp_path / "recordings") as session:
        page = visit_log(visit, session, log)
        temperature = meas.Battery_Temp_degC
        assert drawn_range(page, "meas.Battery_Temp_degC") == pytest.approx(
            (temperature.max(), temperature.min()), abs=0.05
        )
        assert page.locator(".fits li").first.get_attribute("data-twin") == "battery_panasonic"


def test_mf4_with_a_dropped_dbc_becomes_a_twin(visit, tmp_path, data):
    log = data("can_css_imu100_obd2", "session_00000164", "00000001-60FE3F04.MF4")
    database = data("can_css_imu100_obd2", "dbc", "canmod-gps.dbc")
    # In a process of its own, since its libraries are not made for ours.
    text = subprocess.check_output([sys.executable, "-c", BY_ASAMMDF, log, database], text=True)
    speed, valid, begins = json.loads(text.splitlines()[-1])
    speed, valid = np.array(speed), np.array(valid) == 1
    with opened(tmp_path / "recordings") as session:
        # The DBC first: the log is read with it at once.
        page = visit_log(visit, session, database, log)
        assert drawn_range(page, "Speed", begins) == pytest.approx((speed.max(), speed.min()), abs=0.05)
        assert f"{speed.size} values" in row(page, "Speed").inner_text()
        assign(page, Speed="state")
        pull = drafted(page, session, "drive")
        used = rows_of(pull, session.engine.model, "speed")[0]
        np.testing.assert_allclose(used, np.where(valid, speed, np.nan), atol=1e-9)


def written(folder, name):
    """Write twenty values, 5 + 2 k at k seconds, in a format; return the file, its signal, and the DBC of a CAN log."""
    import pyarrow
    import pyarrow.parquet

    t = np.arange(20.0)
    y = 5.0 + 2.0 * t
    path = folder / name
    text = "t,level\n" + "".join(f"{a},{b}\n" for a, b in zip(t, y, strict=True))
    if name.endswith(".csv"):
        path.write_text(text)
    elif name.endswith(".csv.gz"):
        path.write_bytes(gzip.compress(text.encode()))
    elif name.endswith(".parquet"):
        pyarrow.parquet.write_table(pyarrow.table({"t": t, "level": y}), path)
    else:
        text = 'VERSION ""\nBU_: A\nBO_ 256 TANK: 2 A\n SG_ level : 0|16@1+ (0.5,0) [0|0] "mm" A\n'
        with can.Logger(path) as logger:
            for a, b in zip(t, y, strict=True):
                data = int(2 * b).to_bytes(2, "little")
                logger(can.Message(timestamp=1.5e9 + a, arbitration_id=256, data=data, is_extended_id=False, channel=0))
        return path, dbc(folder, text, "tank.dbc")
    return path, None


def test_other_formats_are_drawn_with_the_values_of_the_file(visit, tmp_path):
    endings = (".csv.gz", ".parquet", ".blf")
    files = [written(tmp_path, f"tank{ending}") for ending in endings]
    with opened(tmp_path / "recordings") as session:
        page = visit_log(visit, session, files[-1][1])
        for path, database in files:
            drop(page, path.name, path.read_bytes())
            page.get_by_role("heading", name=path.name).wait_for()
            assert drawn_range(page, "level") == (43.0, 5.0)
            facts = row(page, "level").inner_text()
            assert "20 values · 1 Hz" in facts and ("[mm]" in facts) == (database is not None), path.name
            # A pointer at 60 % of the 19 s reads the sample nearest to 11.4 s.
            box = row(page, "level").locator("svg").bounding_box()
            page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 5)
            assert row(page, "level").locator(".readout").inner_text().split()[:2] == ["0:11.0", "27"]


def test_the_progress_of_a_draft_is_shown_until_it_is_stopped(visit, tmp_path):
    path, _ = written(tmp_path, "tank.csv")
    with opened(tmp_path / "recordings") as session:
        page = visit_log(visit, session, path)
        page.locator(".signal-link").first.wait_for()
        told = {"state": "running", "twin": "tank", "seconds": 3.7, "error": None, "doing": "fitting", "summary": ""}
        page.route("**/api/gallery/log/draft", lambda route: route.fulfill(json=told))
        page.get_by_role("button", name="Draft and run").click()
        page.locator(".draft .row").get_by_text("fitting … 3 s").wait_for()
        assert page.get_by_role("button", name="Draft and run").is_disabled()
        assert page.locator(".draft").get_by_role("button", name="Stop").is_visible()
        told["state"] = "stopped"
        page.locator(".draft .row").get_by_text("stopped").wait_for()
        assert page.locator(".draft").get_by_role("button", name="Stop").is_hidden()
        assert page.get_by_role("button", name="Draft and run").is_enabled()


def test_no_error_is_a_dead_end(visit, tmp_path):
    with opened(tmp_path / "recordings") as session:
        page = visit(session.session.url, ready=None)
        page.locator(".card").first.wait_for()
        drop(page, "photo.jpg", b"\xff\xd8\xff")
        page.locator("#failed").get_by_text("'photo.jpg': is neither a recording (.rrd), a log (").wait_for()
        for name, content, reason in (
            ("noise.mf4", bytes(range(256)) * 8, "noise.mf4: it cannot be read as MF4; check that it is one"),
            ("empty.csv", b"", "empty.csv: the file is empty; record it again"),
        ):
            drop(page, name, content)
            page.locator(".log-failure [role=alert]").get_by_text(reason).wait_for()
            assert str(tmp_path) not in page.locator("body").inner_text()
        # Its time column is asked for; the answer is all it takes.
        drop(page, "plain.csv", b"a,b\n0,7\n1000,9\n2000,8\n")
        page.get_by_text("Which column holds the time?").wait_for()
        page.get_by_label("Unit", exact=True).select_option("ms")
        page.get_by_label("Column", exact=True).select_option("a")
        assert drawn_range(page, "b") == (9.0, 7.0)
        assert "1 Hz" in row(page, "b").inner_text()
        # Back, all dropped files are there, and open again.
        page.get_by_role("link", name="All twins").click()
        page.locator(".card").first.wait_for()
        for name in ("noise.mf4", "empty.csv", "plain.csv"):
            page.locator(f".file[data-name='{name}']").wait_for()
        page.locator(".file[data-name='noise.mf4'] .name").click()
        page.locator(".log-failure").wait_for()
        page.go_back()
        page.locator(".card").first.wait_for()
        # A twin that cannot read a file says so without a path, and what was dropped stays.
        drop(page, "plain.csv", b"a,b\n0,1\n", "[data-name=motor_bench] h2")
        wait_for(lambda: "there is no column 't_s'" in page.locator("#failed").inner_text())
        assert str(tmp_path) not in page.locator("#failed").inner_text()


def test_a_refused_table_is_read_with_what_its_fields_are_given(visit, tmp_path):
    with opened(tmp_path / "recordings") as session:
        page = visit(session.session.url, ready=None)
        page.locator(".card").first.wait_for()
        drop(page, "us.csv", b"time,v\n" + b"".join(b"03/05/2024 08:0%d:00,%d\n" % (k, k) for k in range(3)))
        page.locator(".needs").get_by_text("which may be day/month or month/day").wait_for()
        page.get_by_role("button", name="%m/%d/%Y %H:%M:%S").click()
        assert drawn_range(page, "v") == (2.0, 0.0)
        assert "from 2024-03-05 08:00:00 UTC" in page.locator(".log-head").inner_text()
        assert page.get_by_label("Format", exact=True).input_value() == "%m/%d/%Y %H:%M:%S"
        # Another log begins with what is detected; one that cannot be read has its fields as well.
        drop(page, "comma.csv", b"t,a\n" + b"".join(b'%d,"%d,234"\n' % (k, k + 1) for k in range(3)))
        page.locator(".log-failure [role=alert]").get_by_text(
            "may be 1234 or 1.234; give Decimal . or Decimal ,"
        ).wait_for()
        assert page.get_by_label("Format", exact=True).input_value() == ""
        decimal = page.get_by_label("Decimal", exact=True)
        decimal.fill(";")
        decimal.press("Enter")
        page.locator(".log-failure [role=alert]").get_by_text("decimal ';': is no decimal sign; give . or ,").wait_for()
        assert decimal.input_value() == ";"
        decimal.fill(",")
        decimal.press("Enter")
        assert drawn_range(page, "a") == (3.23, 1.23)
        assert decimal.input_value() == ","


def test_a_thousand_channels_are_grouped_searched_and_drawn_as_they_are_seen(visit, tmp_path):
    t = np.arange(50.0)
    field = np.arange(1200) / 10.0 + np.sin(t)[:, None]
    np.savez(tmp_path / "field.npz", t=t, grid=field.reshape(50, 40, 30), inlet=t)
    with opened(tmp_path / "recordings") as session:
        page = visit_log(visit, session, tmp_path / "field.npz")
        page.get_by_text("1,200 signals").wait_for()
        assert page.locator("details.group").count() == 2
        assert page.locator(".signal").count() <= 101
        page.get_by_role("searchbox", name="Find a signal").fill("grid[39,29]")
        high, low = drawn_range(page, "grid[39,29]")
        assert (high, low) == pytest.approx((119.9 + np.sin(t).max(), 119.9 + np.sin(t).min()), abs=0.5)
        assert page.locator(".signal").count() == 1
