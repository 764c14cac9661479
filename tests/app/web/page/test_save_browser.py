"""What leaves the page: pictures of charts, the track, a link to a moment, read back and compared with the engine."""

import csv
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from app.engine.commands import SetTuning
from tests.app.scripted import pull_all
from tests.app.web.page.browsed import running, until
from tests.waiting import wait_for

pytestmark = pytest.mark.browser


SVG = "{http://www.w3.org/2000/svg}"
ESTIMATE = "#0b62c4"
"""In the light theme; the page of this test is dark."""


def started(request):
    with running(request.param) as session:
        yield session


TWINS = ["motor_winding", "motor_joint"]
session = pytest.fixture(started, scope="module", params=TWINS)
own_session = pytest.fixture(started, params=TWINS)
"""Of a test that changes it."""


def opened(visit, address, beside=None):
    ready = "window.nisus?.drawn > 0 && Boolean(window.nisus.link.status.origin)"
    return visit(address, beside=beside, ready=ready, scheme="dark")


@pytest.fixture
def page(visit, session):
    return opened(visit, session.url)


def saved(page, button, item, folder):
    """The file that a menu gives, by the keyboard alone."""
    page.get_by_role("button", name=button, exact=True).focus()
    page.keyboard.press("Enter")
    wanted = page.get_by_role("menuitem", name=item, exact=True)
    wait_for(lambda: wanted.evaluate("node => node === document.activeElement") or page.keyboard.press("ArrowDown"))
    with page.expect_download() as download:
        page.keyboard.press("Enter")
    path = folder / download.value.suggested_filename
    download.value.save_as(path)
    return path


def numbers(root, anchor):
    """Places and texts of an axis, by how its labels are anchored."""
    labels = [node for node in root.iter(f"{SVG}text") if node.get("text-anchor") == anchor]
    return [(float(node.get("x")), float(node.get("y")), node.text) for node in labels]


def test_a_chart_as_svg_is_what_the_engine_says(page, session, tmp_path):
    model, pull = session.engine.model, pull_all(session.engine)
    state = model.shown_states[-1]
    label = model.label(state.name).replace("_", " ")
    path = saved(page, f"Save the chart of {label}", "SVG", tmp_path)
    assert re.fullmatch(rf"{session.engine.twin.name}-{state.name}-\d+s\.svg", path.name)
    text = path.read_text(encoding="utf-8")
    assert text.count("://") == 1 and not re.search(r"href|<script|url\((?!#frame)", text)
    root = ElementTree.fromstring(text)
    words = " ".join(node.text for node in root.iter(f"{SVG}text"))
    assert f"{session.engine.twin.name}: {label} [{state.unit}]" in words
    assert "± 2σ" in words and "estimate" in words and "truth" in words and "run 0" in words

    # The curve, read by the axes' own labels, is the estimate: times to a pixel, values to a pixel.
    (curve,) = [node for node in root.find(f"{SVG}g").findall(f"{SVG}path") if node.get("stroke") == ESTIMATE
                and node.get("stroke-dasharray") is None]  # fmt: skip
    points = np.array([[float(v) for v in pair] for pair in re.findall(r"[ML]([-\d.]+) ([-\d.]+)", curve.get("d"))])
    (_, y0, v0), *_, (_, y1, v1) = numbers(root, "end")
    values = float(v0) + (points[:, 1] + 4 - y0) * (float(v1) - float(v0)) / (y1 - y0)
    clocks = [(x, sum(60**k * float(part) for k, part in enumerate(reversed(text.split(":")))))
              for x, _, text in numbers(root, "middle")]  # fmt: skip
    (x0, t0), *_, (x1, t1) = clocks
    times = t0 + (points[:, 0] - x0) * (t1 - t0) / (x1 - x0)
    seconds = (pull.events.t - pull.events.t[0]) * 1e-9
    mean = pull.track.mean[:, -1]
    a_pixel, a_moment = abs((float(v1) - float(v0)) / (y1 - y0)), (t1 - t0) / (x1 - x0)
    inside = points[(times > seconds[0]) & (times < seconds[-1])]
    assert len(inside) > 50
    for time, value in zip(times, values, strict=True):
        near = mean[np.abs(seconds - time) <= max(2 * a_moment, 16 * np.median(np.diff(np.unique(seconds))))]
        assert near.size == 0 or near.min() - a_pixel <= value <= near.max() + a_pixel


def test_a_picture_is_as_large_as_it_says_and_light(page, tmp_path):
    from PIL import Image

    path = saved(page, "Save the chart of NIS / dof", "PNG", tmp_path)
    picture = Image.open(path).convert("RGB")
    assert picture.size == (1920, 660) and picture.getpixel((3, 3)) == (255, 255, 255)
    assert np.sum(np.abs(np.asarray(picture).astype(int) - (11, 98, 196)).sum(axis=2) < 30) > 300


def test_two_states_against_each_other(page, session, tmp_path):
    """The end of the drawn curve is where the mean of the last rows is, by the labels of both axes."""
    page.get_by_role("tab", name="XY").click()
    wait_for(lambda: page.evaluate("document.querySelector('#xy canvas').width > 300"))
    page.evaluate("window.told = 0; window.nisus.link.addEventListener('belief', () => (window.told += 1))")
    page.evaluate("window.nisus.view.follow(null)")
    wait_for(lambda: page.evaluate("window.told > 0"))
    roots = []

    def outlined():
        """Whether the file has the ellipses: they are asked for anew whenever another time is shown."""
        # Else it is saved over and over, and of a page that saves ten files on end Chromium takes no more.
        until(page, "window.nisus.xy.belief && window.nisus.xy.stream.x.length > 0")
        path = saved(page, "Save the chart of two states", "SVG", tmp_path)
        roots.append(ElementTree.fromstring(path.read_text(encoding="utf-8")))
        return len(curves_of(roots[-1])) == 3

    wait_for(outlined)
    root = roots[-1]
    curve = curves_of(root)[0]
    x, y = (float(v) for v in re.findall(r"[ML]([-\d.]+) ([-\d.]+)", curve.get("d"))[-1])
    across, up = page.evaluate("[...document.querySelectorAll('#xy select')].map((s) => s.value).reverse()")
    names = [state.name for state in session.engine.model.shown_states]
    last = pull_all(session.engine).track.mean[-64:]  # of a group of rows the extremes are drawn
    bottom = [(a, float(t)) for a, _, t in numbers_of(root, "middle")]
    left = [(b - 4, float(t)) for _, b, t in numbers_of(root, "end")]
    for place, axis, name in ((x, bottom, across), (y, left, up)):
        (p0, v0), *_, (p1, v1) = axis
        value, a_pixel = v0 + (place - p0) * (v1 - v0) / (p1 - p0), abs((v1 - v0) / (p1 - p0))
        rows = last[:, names.index(name)]
        assert rows.min() - a_pixel <= value <= rows.max() + a_pixel


def curves_of(root):
    """The paths of the estimate's colour: where it was, then its ellipses."""
    return [node for node in root.find(f"{SVG}g").findall(f"{SVG}path") if node.get("stroke") == ESTIMATE]


def numbers_of(root, anchor):
    """As `numbers`, of labels that are numbers."""
    labels = [node for node in root.iter(f"{SVG}text") if node.get("text-anchor") == anchor and node.get("x")]
    found = [node for node in labels if re.fullmatch(r"-?[\d.e-]+", node.text)]
    return [(float(node.get("x")), float(node.get("y")), node.text) for node in found]


def test_the_track_that_is_shown(page, session, tmp_path):
    page.evaluate("window.nisus.view.show(10, 25)")
    path = saved(page, "Save", "Track, shown part: CSV", tmp_path)
    assert path.name == f"{session.engine.twin.name}-run0-10-to-25s.csv"
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    t = pull_all(session.engine).events.t
    inside = t[(t >= t[0] + 10_000_000_000) & (t <= t[0] + 25_000_000_000)]
    assert [int(row["t_ns"]) for row in rows] == inside.tolist()
    report = saved(page, "Save", "Report: HTML", tmp_path)
    assert report.suffix == ".html" and "Scores" in report.read_text(encoding="utf-8")


def test_a_link_goes_to_the_moment_and_holds_it(visit, page, session):
    hidden = page.evaluate("window.nisus.charts.charts.at(-1).what.key")
    page.get_by_text("Shown", exact=True).click()
    page.locator("#layout li").last.get_by_role("checkbox").uncheck()
    page.keyboard.press("Escape")
    page.evaluate("window.nisus.view.show(12.3456789, 22.5, 17.25)")
    page.locator("body").press("l")
    wait_for(lambda: "#twin=" in page.evaluate("location.href"))
    address = page.evaluate("location.href")
    assert "token" not in address and f"#twin={session.engine.twin.name}&from=1970-01-01T00:00:12.3456789Z" in address

    page.evaluate("localStorage.clear()")
    other = opened(visit, address, page)
    wait_for(lambda: not other.evaluate("window.nisus.view.following"))
    first, last = other.evaluate("window.nisus.charts.range")
    assert (first, last) == (pytest.approx(12.3456789, abs=1e-9), pytest.approx(22.5, abs=1e-8))
    assert hidden not in other.evaluate("window.nisus.charts.layout.shown().map(([key]) => key)")
    # It is a guest's layout: the next visit has the reader's own.
    assert other.evaluate(f"localStorage.getItem('nisus.charts.{session.engine.twin.name}')") is None
    assert other.evaluate("window.nisus.view.at") == 17.25
    other.locator("#follow").click()
    wait_for(lambda: other.evaluate("location.hash") == "")

    before = other.evaluate("window.nisus.charts.range")
    other.evaluate("location.hash = '#twin=elsewhere&from=1970-01-01T00:00:12Z&span=3'")
    other.get_by_text("the link is of elsewhere").wait_for()
    assert other.evaluate("window.nisus.charts.range") == before


def test_a_plot_of_diagnose_as_a_drawing_of_its_own(page, session, tmp_path):
    """The stems of the file are the autocorrelation that the server gives, on the scale of its own labels."""
    page.get_by_role("tab", name="Diagnose").click()
    wait_for(lambda: page.evaluate("window.nisus.diagnosed > 0"))
    row = page.evaluate("fetch('/api/diagnose').then((answer) => answer.json())")["rows"][0]
    label = f"Autocorrelation of the innovations of {row['name']}"
    path = saved(page, f"Save the plot: {label}", "SVG", tmp_path)
    assert path.suffix == ".svg" and "Autocorrelation" in path.name
    root = ElementTree.fromstring(path.read_text(encoding="utf-8"))
    assert root.find(f"{SVG}title").text == f"{session.engine.twin.name}: {label}"
    stems = [node for node in root.iter(f"{SVG}line") if node.get("x1") == node.get("x2")]
    assert len(stems) == len(row["autocorrelation"]["r"])
    labels = [(float(b) - 3.5, float(text)) for _, b, text in numbers_of(root, "end")]
    (b0, v0), *_, (b1, v1) = sorted(labels)
    drawn = [v0 + (float(node.get("y2")) - b0) * (v1 - v0) / (b1 - b0) for node in stems]
    # Places are rounded to a tenth of a pixel, labels to two figures.
    assert np.allclose(drawn, row["autocorrelation"]["r"], atol=0.02)
    # In the light theme, with the page's style in the file.
    assert {node.get("stroke") for node in stems} == {"rgb(196, 123, 0)"}
    assert not re.search(r"class=|var\(|url\(|https?://(?!www\.w3\.org)", path.read_text(encoding="utf-8"))
    picture = saved(page, f"Save the plot: {label}", "PNG", tmp_path)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_of_a_run_whose_track_is_gone_nothing_is_offered_and_it_says_why(visit, own_session):
    page, engine = opened(visit, own_session.url), own_session.engine
    first = engine.revisions.runs[-1].number
    key = f"Q.{engine.model.noises[0].name}"
    # More than the two seconds apart within which edits of one entry are one.
    for revision, entry in enumerate((key, f"R.{engine.model.row_names[0]}"), start=first + 1):
        engine.submit(SetTuning(entry, 1.5 * engine.tuning.get(entry)))
        wait_for(lambda n=revision: engine.status().revision == n and not engine.status().refolding)
    reason = f"the track of run {first} is gone: load it, and it is folded again"
    page.get_by_role("tab", name="Runs").click()
    page.locator(f'tbody[data-number="{first + 2}"]').wait_for()
    page.get_by_role("button", name=f"Menu of run {first}", exact=True).click()
    for what in ("Report: HTML", "Track: CSV"):
        item = page.get_by_role("menuitem", name=what)
        item.wait_for()
        assert item.get_attribute("aria-disabled") == "true" and item.get_attribute("title") == reason
    page.keyboard.press("Escape")
    # The menu was opened while the run was there, and what is chosen there is no broken download.
    page.evaluate(f"window.nisus.saving.fetched({first}, '/api/track.csv?run={first}')")
    page.get_by_text(f"{reason}; nothing is saved").wait_for()
