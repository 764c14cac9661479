"""The overview of a service in a browser."""

import re

import pytest

from tests import ROOT
from tests.app.web.page.browsed import until
from tests.app.web.page.test_gallery_browser import card, shows
from tests.extensions.service.test_service import Served

pytestmark = pytest.mark.browser

FRAME = """(name) => {
  const found = getComputedStyle(document.querySelector(`.card[data-name=${name}]`));
  return [found.borderColor, found.getPropertyValue("--frame"), found.getPropertyValue("--health-stale")];
}"""


def test_the_overview_of_a_service_shows_health_and_leads_to_the_page_of_each_twin(visit, tmp_path):
    text = (ROOT / "config" / "twins" / "motor_winding.yaml").read_text()
    for name in ("north", "south"):
        (tmp_path / f"{name}.yaml").write_text(text)
    pushed = re.sub(r"source:\n  type: simulator\n(  .*\n)*", "source: {type: push}\n", text)
    (tmp_path / "south.yaml").write_text(re.sub(r"_after: \d+", "_after: 0.2", pushed))
    (tmp_path / "torn.yaml").write_text("model: motor_winding\n")
    service = Served(tmp_path, "north.yaml", "south.yaml", "torn.yaml", "--store", "stores")
    try:
        states = {"north": "running", "south": "running", "torn": "failed"}
        service.wait(lambda twins: {name: twin["state"] for name, twin in twins.items()} == states)
        overview = visit(f"{service.url}/?token={service.token}", ready="window.nisus?.cards === 3")
        order = "[...document.querySelectorAll('.card')].map((card) => card.dataset.name)[0]"
        until(overview, f"{order} === 'torn'")
        card(overview, "torn").get_by_text("source is missing; add it").wait_for()
        card(overview, "north").get_by_text("tracking").wait_for()
        assert (overview.title(), overview.locator("h1").inner_text()) == ("Overview · Nisus", "Overview")
        assert service.ask("/twins/south/api/readings", {"values": {"winding": 40.0}})[0] == 200
        card(overview, "south").get_by_text(re.compile(r"^stale for \d")).wait_for()
        green, grey = (overview.evaluate(FRAME, name) for name in ("north", "south"))
        assert green[0] != grey[0] and grey[1] == grey[2]
        overview.screenshot(path=tmp_path / "overview.png")
        card(overview, "north").get_by_role("link", name="Open").click()
        shows(overview, "north")
        assert overview.url.endswith("/twins/north/")
        overview.evaluate("window.nisus.link.ask('SetTuning', {key: 'Q.temperature', value: 0.5})")
        overview.get_by_role("tab", name="Episodes").click()
        overview.get_by_text("Commands", exact=True).click()
        entry = "session (admin) from 127.0.0.1, run 0: SetTuning, key Q.temperature, value 0.5"
        overview.get_by_text(entry).wait_for()
        overview.screenshot(path=tmp_path / "twin.png")
        overview.locator("#gallery").click()
        until(overview, "window.nisus?.cards === 3")
        card(overview, "north").get_by_role("button", name="Stop").click()
        card(overview, "north").get_by_role("button", name="Start").wait_for()
        until(overview, f"{order} === 'torn'")
        assert service.twins()["south"]["state"] == "running"
    finally:
        service.stop()
