"""A report is one file that needs no other, and says what the fold says."""

import re
from xml.etree import ElementTree

import numpy as np
import pyarrow.parquet as pq
import pytest

from app.cli.main import main
from app.present.export.alarm_guide import advice
from app.present.export.run_charts import run_charts
from estimators.diagnostics.episodes import CAUSES
from estimators.fold import fold
from estimators.log import Log
from estimators.tuning import Tuning
from tests.app.cli.test_check import parsed
from tests.app.scripted import MODEL, readings


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Report and track of a twin one of whose sensors lies for a while."""
    folder = tmp_path_factory.mktemp("report")
    html, track = folder / "report.html", folder / "track.parquet"
    yaml = folder / "lying.yaml"
    yaml.write_text(
        "title: a <motor> & more\nmodel: motor_winding\nestimator: kf\nsensors: {winding: {std: 1}}\n"
        "source:\n  type: simulator\n  seed: 5\n  step: 0.1\n  duration: 300\n  initial: {temperature: 40}\n"
        "  faults:\n    - {kind: noise, sensor: winding, size: 30, start: 100, end: 160}\n"
    )
    assert main(["fold", str(yaml), "--set", "Q.rate=0.002", "--html", str(html), "--out", str(track)]) == 0
    return html.read_text(encoding="utf-8"), pq.read_table(track)


def test_it_is_one_file_and_refers_to_nothing(made):
    html, _ = made
    page = parsed(html)
    assert not page.tags & {"script", "link", "iframe", "img", "object", "embed", "form", "input", "a"}
    for tag, name, value in page.attributes:
        assert name not in ("src", "href", "xlink:href", "srcset", "action") and not name.startswith("on"), (tag, value)
    # A chart refers to its own clip path, and to nothing else.
    ids = re.findall(r'id="([^"]+)"', html)
    assert len(ids) == len(set(ids))
    assert {found for found in re.findall(r"url\(([^)]*)\)", html)} == {f"#{name}" for name in ids}
    assert "://" not in html and "@import" not in html
    assert "a <motor> & more" in " ".join(page.text)


def test_it_says_who_made_it_when_and_of_what(made):
    html, _ = made
    assert re.search(r"Nisus [\d.]+, \d\d \w+ \d{4}, \d\d:\d\d UTC", html)
    text = " ".join(parsed(html).text)
    assert "Kalman filter (kf)" in text and "simulator, of lying.yaml: seed 5" in text and "Q.rate=0.002" in text
    assert text.count("Time counts from the first event") == 1


def test_figures_are_those_of_the_track(made):
    html, track = made
    text = " ".join(parsed(html).text)
    error = track["temperature"].to_numpy() - track["temperature_true"].to_numpy()
    error = error[np.isfinite(error)]
    shown = re.search(r"RMSE of temperature\s+([\d.]+) °C", text)
    assert float(shown[1]) == pytest.approx(np.sqrt(np.mean(error**2)), rel=5e-3)
    verdicts = np.array(track["verdict"].to_pylist())
    assert re.search(rf"readings\s+{np.sum(verdicts != 'none'):,}\s", text)
    nis = track["nis"].to_numpy()[verdicts == "used"]
    assert float(re.search(r"mean NIS\s+([\d,.]+)", text)[1].replace(",", "")) == pytest.approx(nis.mean(), rel=5e-3)


def test_the_episode_is_there_with_its_remedy(made):
    html, _ = made
    text = " ".join(parsed(html).text)
    assert "winding" in text and "Usual cause:" in text and "Response:" in text
    assert "1:40" in text


def test_charts_hold_the_extremes(made):
    """The estimate's curve reaches as high and as low as the track does."""
    html, track = made
    charts = [ElementTree.fromstring(svg) for svg in re.findall(r"<svg.*?</svg>", html, re.DOTALL)]
    chart = next(root for root in charts if root.get("aria-label", "").startswith("temperature"))
    (curve,) = [node for node in chart.find("g").iter("path") if node.get("stroke") == "#0b62c4"]
    ys = np.array([float(y) for y in re.findall(r"[ML][-\d.]+ ([-\d.]+)", curve.get("d"))])
    mean = track["temperature"].to_numpy()
    texts = [node for node in chart.iter("text") if node.get("text-anchor") == "end"]
    marks = [(float(node.get("y")) - 4, float(node.text)) for node in texts]
    (y0, v0), (y1, v1) = marks[0], marks[-1]
    values = v0 + (ys - y0) * (v1 - v0) / (y1 - y0)
    a_pixel = abs((v1 - v0) / (y1 - y0))
    assert values.max() == pytest.approx(mean.max(), abs=0.1 * a_pixel)
    assert values.min() == pytest.approx(mean.min(), abs=0.1 * a_pixel)


def test_one_row_among_thousands_is_seen():
    log, rows = Log.of(MODEL), 9000
    log.extend(readings(np.arange(1.0, rows + 1.0), np.full(rows, 40.0)))
    track = fold("kf", MODEL, Tuning.of(MODEL), log).copy()
    track.mean[:, 0], track.std[:, 0] = 0.0, 1.0
    track.mean[5003, 0] = 77.0
    svg = next(chart for chart in run_charts(MODEL, log.events, track, []) if 'aria-label="temperature' in chart)
    (curve,) = [node for node in ElementTree.fromstring(svg).find("g").iter("path") if node.get("stroke") == "#0b62c4"]
    points = [(float(x), float(y)) for x, y in re.findall(r"[ML]([-\d.]+) ([-\d.]+)", curve.get("d"))]
    x, y = min(points, key=lambda point: point[1])
    others = [height for _, height in points if height > y + 1]
    assert len(points) <= 802 and len(points) - len(others) == 1 and max(others) - y > 80
    left, right = points[0][0], points[-1][0]
    assert (x - left) / (right - left) == pytest.approx(5003 / rows, abs=2 / 400)


@pytest.mark.parametrize("cause", sorted(set(CAUSES) - {"stale", "diverged"}))
def test_every_cause_has_its_response(cause):
    assert len(advice(cause, "Response")) > 20 and "**" not in advice(cause, "Usual cause")
