"""A report is one file without external resources, with the figures of the fold."""

import base64
import json
import re
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest

from app.cli.main import main
from app.engine.outputs.alarm_guide import advice
from app.render import report_charts
from app.render.report_charts import charts_html, page_labels
from app.twin.twin import load_twin
from estimators.diagnostics.detectors import CAUSES
from estimators.fold import fold
from estimators.log import Log
from estimators.tuning import Tuning
from tests.app.cli.test_check import ParsedHtml
from tests.app.scripted import MODEL, decoded, readings
from tests.cases import cases


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


def data_of(html):
    """The data of the charts, and the frame of a stream as times and columns by name."""
    data = json.loads(re.search(r'<script id="chart-data" type="application/json">(.*?)</script>', html)[1])

    def columns(stream):
        frame = base64.b64decode(data["streams"][stream])
        header, seconds, values = decoded(frame)
        return seconds, dict(zip(header["columns"], values + np.array(header["offsets"])[:, None], strict=True))

    return data, columns


def test_it_is_one_file_and_may_load_nothing(made):
    html, _ = made
    page = ParsedHtml(html)
    assert not page.tags & {"link", "iframe", "object", "embed", "form", "input", "a"}
    policy = next(value for tag, name, value in page.attributes if tag == "meta" and "default-src" in (value or ""))
    assert "default-src 'none'" in policy and "http" not in policy and "*" not in policy
    for tag, name, value in page.attributes:
        assert name not in ("src", "href", "srcset", "action") and not name.startswith("on"), (tag, value)
    assert "@import" not in html and "a <motor> & more" in " ".join(page.text)


def test_it_says_who_made_it_when_and_of_what(made):
    html, _ = made
    assert re.search(r"Nisus [\d.]+, \d\d \w+ \d{4}, \d\d:\d\d UTC", html)
    text = " ".join(ParsedHtml(html).text)
    assert "Kalman filter (kf)" in text and "simulator, of lying.yaml: seed 5" in text and "Q.rate=0.002" in text
    assert text.count("Time counts from the first event") == 1


def test_figures_are_those_of_the_track(made):
    html, track = made
    text = " ".join(ParsedHtml(html).text)
    error = track["temperature"].to_numpy() - track["temperature_true"].to_numpy()
    error = error[np.isfinite(error)]
    shown = re.search(r"RMSE of temperature\s+([\d.]+) °C", text)
    assert float(shown[1]) == pytest.approx(np.sqrt(np.mean(error**2)), rel=5e-3)
    verdicts = np.array(track["verdict"].to_pylist())
    assert re.search(rf"measurements\s+{np.sum(verdicts != 'none'):,}\s", text)
    nis = track["nis"].to_numpy()[verdicts == "used"]
    assert float(re.search(r"mean NIS\s+([\d,.]+)", text)[1].replace(",", "")) == pytest.approx(nis.mean(), rel=5e-3)


def test_the_episode_is_there_with_its_remedy(made):
    html, _ = made
    text = " ".join(ParsedHtml(html).text)
    assert "winding" in text and "Usual cause:" in text and "Response:" in text
    assert "1:40" in text


def test_charts_hold_the_extremes(made):
    """The estimate's column reaches as high and as low as the track does."""
    html, track = made
    data, columns = data_of(html)
    seconds, found = columns("live")
    mean = track["temperature"].to_numpy()
    assert np.nanmax(found["mean:temperature"]) == pytest.approx(mean.max(), rel=1e-6)
    assert np.nanmin(found["mean:temperature"]) == pytest.approx(mean.min(), rel=1e-6)
    assert seconds[0] == 0.0 and seconds[-1] == pytest.approx(300.0, abs=0.2)
    assert data["episodes"][0]["from"] == pytest.approx(100.0, abs=1.0)


def test_one_row_among_thousands_is_seen():
    log, rows = Log.of(MODEL), 9000
    log.extend(readings(np.arange(1.0, rows + 1.0), np.full(rows, 40.0)))
    track = fold("kf", MODEL, Tuning.of(MODEL), log).copy()
    track.mean[:, 0], track.std[:, 0] = 0.0, 1.0
    track.mean[5003, 0] = 77.0
    _, columns = data_of(charts_html(Tuning.of(MODEL), log.events, track, [], None, None))
    seconds, found = columns("live")
    drawn = np.isfinite(found["mean:temperature"])
    seconds, values = seconds[drawn], found["mean:temperature"][drawn]
    assert len(values) <= 802 and values.max() == 77.0 and np.sum(values > 1.0) == 1
    assert seconds[values.argmax()] == pytest.approx(5003, abs=2 * rows / 400)


CHART = """
import { line } from "../chart.js";
export const order = 0;
export default (charts) => [{
  key: "own", title: "a chart of one file", unit: "", weight: 1, columns: ["nis_mean"],
  series: { nis: line("estimate") }, data: () => ({ x: charts.live.x, nis: charts.live.column("nis_mean") }),
  range: () => [0, 10], says: (value) => value("nis").toFixed(1),
}];
"""


@pytest.mark.browser
def test_it_draws_the_page_s_charts_without_a_network(browser, made, tmp_path, monkeypatch):
    """Also one that is a file more in the folder of charts; on paper each is a picture."""
    pages = tmp_path / "page"
    shutil.copytree(report_charts.PAGE, pages)
    (pages / "charts" / "own.js").write_text(CHART)
    monkeypatch.setattr(report_charts, "PAGE", pages)
    yaml, path = tmp_path / "quiet.yaml", tmp_path / "report.html"
    yaml.write_text(
        "title: quiet\nmodel: motor_winding\nestimator: kf\nsensors: {winding: {std: 1}}\n"
        "source: {type: simulator, seed: 5, step: 0.1, duration: 60}\n"
    )
    assert main(["fold", str(yaml), "--html", str(path)]) == 0
    context = browser.new_context(viewport={"width": 1000, "height": 900}, offline=True)
    page, wrong = context.new_page(), []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("console", lambda message: wrong.append(message.text))
    page.on("request", lambda request: request.url.startswith(("file:", "data:")) or wrong.append(request.url))
    page.goto(path.as_uri())
    page.locator(".paper").nth(4).wait_for(state="attached")
    titles = page.locator("#charts article > header h3").all_inner_texts()
    assert titles == ["a chart of one file", "rate", "temperature", "NIS / dof", "winding"]
    blue = """[...document.querySelectorAll("#charts canvas")].map((canvas) => {
        const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
        let count = 0;
        for (let k = 0; k < data.length; k += 4) if (data[k + 3] > 100 && data[k + 2] > data[k] + 60) count++;
        return count;
    })"""
    assert min(page.evaluate(blue)[:3]) > 200
    page.emulate_media(media="print")
    assert page.locator(".paper").first.is_visible() and not page.locator("#charts canvas").first.is_visible()
    context.close()
    assert wrong == []


@pytest.mark.parametrize("cause", sorted(set(CAUSES) - {"stale", "diverged"}))
def test_every_cause_has_its_response(cause):
    assert len(advice(cause, "Response")) > 20 and "**" not in advice(cause, "Usual cause")


@cases(__file__, "labels.csv")
def test_labels_are_those_of_the_twin_and_positions_on_its_grid(twin, labels):
    """By hand: row 13 of a grid from 58° N southwards in steps of a quarter of a degree is 54.75° N."""
    loaded, labels = load_twin(twin), json.loads(labels)
    found = page_labels(loaded.model, loaded.config.view)
    assert {name: found.get(name) for name in labels} == labels and bool(found) == bool(labels)
