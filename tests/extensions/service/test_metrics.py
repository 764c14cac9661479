"""Metrics for Prometheus: those of the published state."""

import json
import re
import sys
from pathlib import Path

from prometheus_client.parser import text_string_to_metric_families

from tests.app.engine.outputs.pushed import publishing, push
from tests.app.engine.outputs.test_alerts import DEAD, started
from tests.app.web.test_state_api import page, state
from tests.waiting import wait_for

__all__ = ["page"]


def test_metrics_are_those_of_the_message(page):
    """Read by the parser of another package's own format."""
    message = state(page)

    def samples(query=""):
        families = text_string_to_metric_families(page.client.get(f"/metrics{query}").text)
        return {(item.name, *sorted(item.labels.items())): item.value for family in families for item in family.samples}

    twin, found = ("twin", message["twin"]), samples()
    on = [dict(labels)["health"] for (name, *labels), value in found.items() if name == "nisus_health" and value == 1.0]
    assert on == [message["health"]]
    assert found["nisus_nis_ratio", twin] == message["nis"]
    assert found["nisus_measurements_total", ("sensor", "winding"), twin, ("verdict", "used")] == 50.0
    assert found["process_resident_memory_bytes",] > 1e6
    assert not any(name.startswith("nisus_state_m") for name, *_ in found)
    first = message["states"][0]
    labels = ("state", first["name"]), twin, ("unit", first["unit"])
    found = samples("?states=true")
    assert (found["nisus_state_mean", *labels], found["nisus_state_std", *labels]) == (first["value"], first["std"])
    assert found["nisus_state_grade", ("grade", first["grade"]), *labels[:2]] == 1.0


def test_problems_are_counted_by_kind_and_the_dashboard_asks_for_what_there_is(page):
    page.engine.notices.report("frames lost", "the socket dropped 3 frames", times=3)
    families = list(text_string_to_metric_families(page.client.get("/metrics?states=true").text))
    (problems,) = (family for family in families if family.name == "nisus_problems")
    assert [(item.labels["kind"], item.value) for item in problems.samples] == [("frames lost", 3.0)]
    # Without a sample, as there is no clock to measure the latency by, a metric has the label of its twin.
    known = {family.name: {"twin"} for family in families}
    known |= {item.name: set(item.labels) for family in families for item in family.samples}
    panels = json.loads(Path("docs/grafana.json").read_text())["panels"]
    asked = [target["expr"] for panel in panels for target in panel["targets"]]
    assert len(asked) > 8
    for expression in asked:
        for name, labels in re.findall(r"\b((?:nisus|process)_\w+)(?:\{([^}]*)\})?", expression):
            assert name in known, expression
            assert set(re.findall(r"(\w+)[!=]", labels)) <= known[name], expression


def test_alerts_are_counted_by_receiver(serve, hook):
    with publishing(serve, started({"dead": DEAD, "ops": hook.section})) as page:
        for k in range(30):
            push(page, (k, 50.0))

        def told(line):
            return line in page.client.get("/metrics").text

        wait_for(lambda: told('nisus_output_up{output="alerts to dead",twin="motor_winding"} 0.0'))
        wait_for(lambda: told('nisus_alerts_total{outcome="delivered",receiver="ops",twin="motor_winding"} 1.0'))


def test_metrics_name_the_package_that_they_need(page, monkeypatch):
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    answer = page.client.get("/metrics")
    assert (answer.status, "pip install 'nisus[service]'" in answer.text) == (501, True)


def test_a_wrong_value_is_refused_with_its_rule(page):
    answer = page.client.get("/metrics?states=all")
    assert (answer.status, page.client.get("/metrics?states=true").status) == (400, 200)
    assert json.loads(answer.text)["error"] == "metrics: states is 'all'; it must be true or false"
