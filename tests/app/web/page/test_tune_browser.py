"""The Tune panel of every bundled twin: sliders span it, and nothing in it is cut off."""

from types import SimpleNamespace

import pytest

from app.twin.twin import load_twin
from app.web.twin_json import model_json
from config.yaml_files import shipped

pytestmark = pytest.mark.browser

BUILD = """async (model) => {
  const { Tune } = await import("/page/tune.js");
  const link = Object.assign(new EventTarget(), { connected: false, status: {}, ask: async () => null });
  const tune = new Tune(model, link);
  const wrong = [];
  const check = (where) => {
    for (const node of document.querySelectorAll("#tune details")) node.open = true;
    const panel = document.getElementById("left").clientWidth;
    for (const knob of document.querySelectorAll("#tune .knob")) {
      const name = `${where} ${knob.dataset.key ?? ""}`;
      for (const part of knob.querySelectorAll("label, .field, .unit, .steps"))
        if (part.scrollWidth > part.clientWidth + (getComputedStyle(part).display === "inline" ? Infinity : 0))
          wrong.push(`${name}: ${part.className || part.tagName} ${part.scrollWidth} > ${part.clientWidth}`);
      if (knob.scrollWidth > knob.clientWidth) wrong.push(`${name} is wider than the panel`);
      const unit = knob.querySelector(".unit")?.getBoundingClientRect();
      if (unit?.width && unit.right > panel) wrong.push(`${name}: its unit leaves the panel`);
      const slider = knob.querySelector("input[type=range]");
      if (slider && slider.clientWidth < 0.85 * panel) wrong.push(`${name}: slider ${slider.clientWidth} of ${panel}`);
    }
  };
  for (const entry of model.estimators.filter((item) => !item.reason)) {
    tune.build(entry);
    check(entry.name);
  }
  return [wrong, document.querySelectorAll("#tune .knob").length];
}"""


@pytest.fixture(scope="module")
def models():
    """What the page gets of each bundled twin, by its name."""
    twins = {name: load_twin(name) for name in shipped()}
    return {
        name: model_json(SimpleNamespace(model=twin.model, twin=twin, pairs=twin.pairs)) for name, twin in twins.items()
    }


@pytest.mark.parametrize("width", [1440, 1920])
def test_units_are_whole_and_sliders_span_the_panel(visit, session, models, width):
    page = visit(session.url, size=(width, 900))
    for name, model in models.items():
        wrong, knobs = page.evaluate(BUILD, model)
        assert wrong == [] and knobs > 0, name
