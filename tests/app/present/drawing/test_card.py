"""Pictures of twins for the gallery: that what is drawn is what was folded, and an image what its numbers are."""

import base64
import io
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from app.cli.main import main
from app.present.drawing import card
from app.present.drawing.colors import ESTIMATE, gradient
from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from app.web.gallery.cards import picture_file
from config.loader import find, shipped
from estimators.fold import Fold
from estimators.log import truth_of

SVG = "{http://www.w3.org/2000/svg}"


def points(svg, kind):
    """Every path of a kind, as arrays (n, 2)."""
    paths = [item.get("d") for item in ET.fromstring(svg).iter(f"{SVG}path") if item.get("class") == kind]
    return [np.array(re.findall(r"(-?[\d.]+) (-?[\d.]+)", path), float) for path in paths]


def test_a_chart_is_the_estimate_in_its_band_and_the_truth():
    twin = load_twin("motor_winding")
    log, _ = read_log(twin, None)
    svg = card.picture_of(twin, log)
    fold = Fold(twin.estimator, twin.model, twin.tuning, log, pairs=twin.pairs)
    fold.advance()
    (estimate,), (truth,), (band,) = (points(svg, kind) for kind in ("estimate", "truth", "band"))
    # The rate is what no sensor reads; its true extremes say how many pixels it takes.
    rows, values = truth_of(log.events, 1)
    rate = fold.track.mean[:, 1]
    pixels = np.polyfit([values.min(), values.max()], [truth[:, 1].max(), truth[:, 1].min()], 1)
    seconds = (log.t[: log.n] - log.t[0]) / (log.t[log.n - 1] - log.t[0])
    across = card.MARGIN + (card.WIDTH - 2 * card.MARGIN) * seconds
    for line, at, told in ((estimate, np.arange(log.n), rate), (truth, rows, values)):
        expected = np.polyval(pixels, told)
        near = [np.abs(line[:, 1] - y).min() for y in expected[at.size // 2 :]]
        # A line has a point in each 150th of the time, and a value stands for less than two of them.
        assert np.median(near) < 0.3, line
    half = 2.0 * fold.track.std[-1, 1] * -pixels[0]
    at_end = band[np.abs(band[:, 0] - across[-1]) < 0.1][:, 1]
    np.testing.assert_allclose(np.ptp(at_end), 2 * half, atol=0.3)
    assert len(estimate) == card.POINTS


def test_an_image_is_what_its_numbers_are():
    from PIL import Image

    values = np.array([[0.0, 1.0, 2.0], [3.0, np.nan, 6.0]])
    text = card._image(values, ESTIMATE, 0, 0, 30, 20)
    data = base64.b64decode(re.search(r"base64,([^\"]+)", text)[1])
    seen = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    colors = gradient(ESTIMATE.colors)
    assert seen.shape == (2, 3, 3)
    np.testing.assert_array_equal(seen[0, 0], colors[0])
    np.testing.assert_array_equal(seen[1, 2], colors[254])
    np.testing.assert_array_equal(seen[1, 1], (205, 205, 210))  # unknown
    np.testing.assert_array_equal(seen[1, 0], colors[127])


def test_a_line_is_cut_where_nothing_is_known():
    text = card._line(np.arange(5.0), np.array([1.0, 2.0, np.nan, 4.0, 5.0]), "truth")
    assert text == '<path class="truth" d="M0.0 1.0L1.0 2.0M3.0 4.0L4.0 5.0"/>'
    assert card._line(np.arange(2.0), np.full(2, np.nan), "truth") == ""


def test_a_path_keeps_its_shape_however_it_is_turned():
    rng = np.random.default_rng(3)
    x, y = rng.normal(0, 1, 40), rng.normal(0, 9, 40)
    across, up = card._turned(x, y, x, y)
    assert np.std(across) > np.std(up)
    first, again = ((a[:, None] - a) ** 2 + (b[:, None] - b) ** 2 for a, b in ((x, y), (across, up)))
    np.testing.assert_allclose(first, again, atol=1e-9)


@pytest.mark.parametrize("name", shipped())
def test_every_twin_that_ships_has_a_picture_that_asks_nobody_for_anything(name):
    text = picture_file(find(name)).read_text()
    root = ET.fromstring(text)
    assert root.get("viewBox") == f"0 0 {card.WIDTH} {card.HEIGHT}" and len(text) < 100_000
    drawn = [item for item in root if item.tag in (f"{SVG}path", f"{SVG}image", f"{SVG}circle")]
    assert drawn
    assert not re.search(r"<script|on\w+=|url\(|https?://(?!www\.w3\.org/2000/svg)", text)
    for image in root.iter(f"{SVG}image"):
        assert image.get("href").startswith("data:image/png;base64,")


def test_the_command_draws_that_of_an_own_twin_beside_it(tmp_path, capsys):
    path = tmp_path / "pump.yaml"
    path.write_text(
        "model: motor_winding\nestimator: kf\n"
        "source: {type: simulator, step: 0.5, duration: 20, sensors: {winding: {every: 1}}}\n"
    )
    assert main(["twins", str(path), "--picture"]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "pump.svg")
    assert len(points((tmp_path / "pump.svg").read_text(), "estimate")) == 1
