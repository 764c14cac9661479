"""Charts as files and pictures for the gallery show the fold; a missing Matplotlib is reported in one line."""

import base64
import io
import re
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from PIL import Image

from app.charts.colors import ESTIMATE, LIGHT, Scale, gradient
from app.cli.main import main
from app.extensions.plot import card
from app.extensions.plot.track import TrackSeries, draw_state, hex_color, new_figure, plot_track, plotter, time_unit
from estimators import MODELS, Log, fold
from estimators.errors import ConfigError
from estimators.track import USED
from tests.skips import recorded
from tests.support import folded


@pytest.fixture(scope="module")
def run():
    model = MODELS["motor_winding"]
    log = Log.of(model)
    rng = np.random.default_rng(1)
    t = np.arange(1.0, 201.0)
    log.add("winding", t, np.where(t == 100.0, 200.0, 40.0 + rng.normal(0, 2, t.size)))
    return fold("kf", model, log, gate=0.9999)


def test_a_plot_has_the_states_with_bands_and_measurements_and_the_nis(run):
    figure = plot_track(run.model, run.events, run.track, title="motor")
    rate, temperature, innovation, nis = figure.axes
    lines = {line.get_label(): line for line in temperature.lines}
    np.testing.assert_array_equal(lines["estimate"].get_ydata(), run.mean[:, 0])
    assert lines["rejected"].get_ydata().tolist() == [200.0]
    assert len(lines["measurement"].get_ydata()) == 199
    band = temperature.collections[0].get_paths()[0].vertices
    at_end = band[band[:, 0] == band[:, 0].max(), 1]
    assert np.ptp(at_end) == pytest.approx(4.0 * run.std[-1, 0])
    assert "temperature" in temperature.get_ylabel() and "°C" in temperature.get_ylabel()
    assert "measurement" not in {line.get_label() for line in rate.lines}
    mean = next(line for line in nis.lines if line.get_label() == "windowed mean").get_ydata()
    np.testing.assert_array_equal(mean, run.track.nis_mean)


def test_innovations_are_drawn_one_by_one_with_their_band_and_those_off_the_chart_at_its_edge(run):
    """The filter's own ν and ± 2 √S; the measurement of 200 °C was rejected, 160 °C above its prediction."""
    axes = plot_track(run.model, run.events, run.track).axes[2]
    assert "innovation" in axes.get_ylabel() and "°C" in axes.get_ylabel()
    lines = {line.get_label(): line for line in axes.lines}
    used = run.track.verdict == USED
    np.testing.assert_array_equal(lines["innovation"].get_ydata(), run.track.innovation[used, 0])
    assert used.sum() == 199
    (edge,) = lines["rejected, off the chart"].get_ydata()
    assert np.abs(run.track.innovation[used, 0]).max() < edge < 20.0 and edge < axes.get_ylim()[1]
    band = axes.collections[0].get_paths()[0].vertices
    at_end = band[band[:, 0] == band[:, 0].max(), 1]
    np.testing.assert_allclose(np.unique(at_end), 2.0 * run.track.innovation_std[-1, 0] * np.array([-1, 1]), rtol=1e-12)


def test_of_many_dots_a_sample_and_the_extremes_are_drawn():
    """White noise of 40,000 measurements: the dots have its spread, which extremes alone would not, and its range."""
    model, n = MODELS["motor_winding"], 40_000
    log = Log.of(model)
    values = 40.0 + np.random.default_rng(1).normal(0, 2, n)
    log.add("winding", np.arange(1.0, n + 1.0), values)
    run = fold("kf", model, log)
    seconds, dots = TrackSeries(model, run.events, run.track)["innovation:winding"]
    own = run.track.innovation[:, 0]
    assert 8_000 < dots.size <= 10_000 and set(dots) <= set(own)
    assert (dots.min(), dots.max()) == (own.min(), own.max())
    # A tenth is extremes of 80 each, of mean square 6: √(0.9 + 0.1 · 6) = 1.22. Extremes alone would have 2.4.
    assert own.std() < dots.std() < 1.3 * own.std()
    middle = np.mean(np.abs(dots) < 0.5 * own.std()) / np.mean(np.abs(own) < 0.5 * own.std())
    assert 0.85 < middle < 1.0


def test_a_track_draws_itself_for_notebooks_and_papers(run, tmp_path):
    figure = run.plot()
    assert len(figure.axes) == 4 and figure.axes[0].get_title(loc="left") == "motor_winding, kf"
    assert figure._repr_png_().startswith(b"\x89PNG")  # what IPython calls for the value of a cell
    figure.savefig(tmp_path / "run.pdf")
    assert (tmp_path / "run.pdf").read_bytes().startswith(b"%PDF")


def test_a_figure_says_what_it_leaves_out():
    model = MODELS["lorenz96"]
    log = Log.of(model)
    name = model.sensor_names[0]
    rows = len(model.sensors[0].rows)
    log.add(name, np.arange(1.0, 6.0) * 0.05, np.zeros((5, rows)))
    figure = fold("ekf", model, log).plot("test")
    assert figure.axes[0].get_title(loc="left") == f"test, 8 of 40 states, 6 of {rows} sensor rows"
    assert len(figure.axes) == 8 + 6 + 1


def test_the_line_of_an_angle_has_a_gap_where_it_leaves_the_chart():
    """Three turns: the line leaves at π and comes back at -π, and is whole in between; so is the truth."""
    model, n = MODELS["road_car"], 300
    log, heading = Log.of(model), model.state_names.index("heading")
    log.add("gnss_heading", np.arange(n) * 0.1, np.zeros(n))
    run = fold("ekf", model, log)
    angle = np.linspace(0.0, 6 * np.pi, n)
    run.track.mean[:, heading], run.track.std[:, heading] = angle, 0.01
    axes = new_figure(1.0, 1.0).add_subplot()
    draw_state(axes, TrackSeries(model, run.events, run.track), "heading")
    values = next(line for line in axes.lines if line.get_label() == "estimate").get_ydata()
    wrapped = np.angle(np.exp(1j * angle))
    leaves = 1 + np.flatnonzero(np.abs(np.diff(wrapped)) > np.pi)
    assert leaves.size == 3 and np.flatnonzero(np.isnan(values)).tolist() == leaves.tolist()
    known = ~np.isnan(values)
    np.testing.assert_allclose(values[known], wrapped[known], atol=1e-12)


@pytest.mark.parametrize(("ending", "magic"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_fold_draws_into_the_format_of_the_ending(ending, magic, tmp_path, capsys):
    path = tmp_path / f"run.{ending}"
    assert main(["fold", "motor_winding", "--duration", "20", "--plot", str(path)]) == 0
    assert path.read_bytes().startswith(magic)


def test_another_ending_and_a_missing_matplotlib_are_one_line(tmp_path, monkeypatch, capsys):
    assert main(["fold", "motor_winding", "--plot", str(tmp_path / "run.bmp")]) == 2
    assert ".png" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ConfigError, match=r"nisus\[plot\]"):
        plotter(tmp_path / "run.png")


@pytest.mark.parametrize(
    ("span", "name"),
    [(0.0, "s"), (179.0, "s"), (180.0, "min"), (3600.0, "min"), (10_800.0, "h"), (86400.0, "h"), (3 * 86400.0, "d")],
)
def test_the_time_unit_suits_the_span(span, name):
    assert time_unit(span).name == name


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
