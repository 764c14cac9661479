"""A large field in headless Chromium: the map that is drawn is the estimate, before and after another filter."""

import io

import numpy as np
import pytest

from app.live.commands import SetEstimator
from app.live.engine import Engine
from app.twin.twin import load_twin
from app.views.viser.guarded_server import HEADER
from app.views.viser.view import ViserView
from tests.app.scripted import Scripted
from tests.app.test_field_views import PLATE, SHAPE
from tests.waiting import wait_for

pytestmark = pytest.mark.browser


@pytest.fixture
def engine(tmp_path):
    (tmp_path / "plate.py").write_text(
        f"from estimators.models.thermal_field import thermal_field\nPlate = thermal_field{(*SHAPE, 2)}\n"
    )
    (tmp_path / "plate.yaml").write_text(PLATE)
    twin = load_twin(tmp_path / "plate.yaml")
    recorded, source = twin.open_source(lambda key, text: None), Scripted()
    engine = Engine(twin, lambda report: source)
    engine.start()
    while (batch := recorded.read(0.0)) is not None:
        source.put(batch)
    source.put(None)
    wait_for(lambda: engine.status().finished)
    yield engine
    engine.stop()


@pytest.fixture
def page(browser, engine):
    view = ViserView(engine, secret="s3cret")
    view.start()
    context = browser.new_context(viewport={"width": 900, "height": 1300}, extra_http_headers={HEADER: "s3cret"})
    page = context.new_page()
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(f"http://127.0.0.1:{view.port}/")
    yield page
    view.stop()
    assert errors == []


def estimate(engine):
    """The newest picture's means, (rows, columns)."""
    cursor = engine.cursor()
    pull = engine.pull(cursor)
    engine.release(cursor)
    return next(picture.mean for picture in reversed(pull.pictures) if picture.mean is not None)


def cells(page):
    """The colours (rows, columns, 3) on the screen in the middle of each cell; None if there is no map."""
    from PIL import Image

    colours = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(float)
    # Below Viser's own controls.
    colours = colours[320:]
    coloured = np.ptp(colours, axis=2) > 40
    wide = np.flatnonzero(coloured.mean(axis=0) > 0.2)
    if not wide.size:
        return None
    # The map is the first of the two runs of columns; the scale stands beside it.
    columns = np.split(wide, np.flatnonzero(np.diff(wide) > 1) + 1)[0]
    rows = np.flatnonzero(coloured[:, columns].mean(axis=1) > 0.5)
    if columns.size < 100 or rows.size < 50:
        return None
    x = columns[0] + columns.size * (np.arange(SHAPE[1]) + 0.5) / SHAPE[1]
    y = rows[0] + rows.size * (np.arange(SHAPE[0]) + 0.5) / SHAPE[0]
    # A third of a cell's side around its middle: in some of them stands the dot of a sensor.
    off = np.round(np.linspace(-1 / 6, 1 / 6, 9) * columns.size / SHAPE[1])
    at = np.ix_(range(SHAPE[0]), range(SHAPE[1]))
    patches = np.stack([colours[np.int64(y + dy)[at[0]], np.int64(x + dx)[at[1]]] for dy in off for dx in off])
    return np.median(patches, axis=0)


def likeness(page, engine):
    """Rank correlation of how bright a cell is with its estimate: the palette grows brighter from cold to warm."""
    found = cells(page)
    if found is None:
        return 0.0
    bright = found @ [0.299, 0.587, 0.114]
    ranks = [np.argsort(np.argsort(values.ravel())) for values in (bright, estimate(engine))]
    return float(np.corrcoef(ranks)[0, 1])


def test_the_map_is_drawn_and_still_is_with_another_filter(page, engine):
    wait_for(lambda: likeness(page, engine) > 0.95)
    before = cells(page), estimate(engine)
    engine.submit(SetEstimator("etkf"))
    wait_for(lambda: engine.status().estimator == "etkf" and not engine.status().refolding)
    wait_for(lambda: not np.array_equal(estimate(engine), before[1]))
    wait_for(lambda: likeness(page, engine) > 0.95 and not np.array_equal(cells(page), before[0]))
