"""Pictures of twins for the gallery show the fold."""

import base64
import io
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from PIL import Image

from app.cli.main import main
from app.extensions.plot import card
from app.extensions.plot.track import hex_color
from app.present.drawing.colors import ESTIMATE, LIGHT, Scale, gradient
from tests.skips import recorded
from tests.support import folded

SVG = "{http://www.w3.org/2000/svg}"


def paths(svg, color):
    """Every line of a colour of the theme, as arrays (n, 2) of points."""
    themed = f"stroke: var(--{color},{hex_color(getattr(LIGHT, color))})"
    lines = [item.get("d") for item in ET.fromstring(svg).iter(f"{SVG}path") if themed in (item.get("style") or "")]
    return [np.array(re.findall(r"(-?[\d.]+) (-?[\d.]+)", line), float) for line in lines]


def drawn(name, **overrides):
    """The picture of a twin, its log, and the fold that it shows."""
    twin, log = recorded(name, overrides=overrides)
    fold = folded(twin.estimator, twin.model, log, twin.tuning, pairs=twin.pairs)
    return card.picture_of(twin, log), log, fold


def test_a_card_shows_the_estimate_of_the_state_that_no_sensor_measures():
    picture, log, fold = drawn("motor_winding")
    (line,), (truth,) = (paths(picture, color) for color in ("estimate", "truth"))
    rate, seconds = fold.track.mean[:, 1], (log.events.t - log.t[0]) * 1e-9
    assert line[0, 0] == pytest.approx(card.MARGIN, abs=0.1)
    assert line[-1, 0] == pytest.approx(card.WIDTH - card.MARGIN, abs=0.1)
    # Pixels are a linear function of seconds and rates.
    across = np.interp(line[:, 0], [card.MARGIN, card.WIDTH - card.MARGIN], [0.0, seconds[-1]])
    told = np.interp(across, seconds, rate)
    scale = np.polyfit(told, line[:, 1], 1)
    assert scale[0] < 0.0
    assert np.median(np.abs(np.polyval(scale, told) - line[:, 1])) < 0.3
    assert len(truth) > 20


def test_the_pixels_of_many_states_are_their_values_over_time():
    picture, _, fold = drawn("lorenz96", **{"source.duration": "5"})
    found = base64.b64decode(re.search(r'data:image/png;base64,([^"]+)"', picture)[1])
    values = fold.track.mean.T
    rows, columns = (-(-n // card.MAX_IMAGE_PIXELS) for n in values.shape)
    values, scale = values[::rows, ::columns], Scale(ESTIMATE)
    scale.fit(values)
    expected = gradient(ESTIMATE.colors)[scale.indices(values)]
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(found)).convert("RGB")), expected)


def test_a_path_keeps_its_shape_however_it_is_turned():
    path = np.random.default_rng(3).normal(0, 1, (2, 40)) * [[1.0], [9.0]]
    turn = card._long_side_across(path)
    np.testing.assert_allclose(turn @ turn.T, np.eye(2), atol=1e-12)
    across, up = turn @ path
    assert np.std(across) > np.std(up)


def test_the_command_draws_that_of_an_own_twin_beside_it(tmp_path, capsys):
    path = tmp_path / "pump.yaml"
    path.write_text(
        "model: motor_winding\nestimator: kf\n"
        "source: {type: simulator, step: 0.5, duration: 20, sensors: {winding: {every: 1}}}\n"
    )
    assert main(["twins", str(path), "--picture"]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "pump.svg")
    assert len(paths((tmp_path / "pump.svg").read_text(), "estimate")) == 1
