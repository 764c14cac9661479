"""The overview of a fleet: parts of the table in any order, metrics, and the page of an asset on demand."""

import itertools
import json
import os
import re
import subprocess
import sys
from contextlib import contextmanager
from types import SimpleNamespace
from urllib.request import ProxyHandler, Request, build_opener

import numpy as np
import pytest
from playwright.sync_api import expect

from app.extensions.archive.parts import parts_of
from app.extensions.fleet.api import FleetApi, id_of
from app.extensions.fleet.archive import AssetHistory
from app.extensions.fleet.plan import load_fleet
from app.extensions.fleet.running import RunningFleet
from estimators.errors import ConfigError
from estimators.fleet.siblings import siblings
from estimators.track import HEALTH_NAMES
from tests import ROOT
from tests.extensions.fleet.test_command import FLEET, pump_rows, write
from tests.waiting import LIMIT_S, wait_for


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """A folder with the YAML of a fleet of 60 assets and their rows."""
    folder = tmp_path_factory.mktemp("fleet")
    write(folder / "a.csv", pump_rows(assets=60, count=12))
    (folder / "pumps.yaml").write_text(FLEET.format(files="a.csv"))
    return folder


@pytest.fixture(scope="module")
def running(fleet):
    found = RunningFleet(load_fleet(fleet / "pumps.yaml"), lambda key, text: None, threads=1)
    found.run()
    yield found
    found.stop()


def test_parts_of_the_table_are_in_order(running):
    api = FleetApi(running)
    _, names, table = running.table()
    answer = api.rows(first=0, count=60)
    assert answer["found"] == answer["assets"] == len(answer["rows"]) == 60
    health = [HEALTH_NAMES.index(row["health"]) for row in answer["rows"]]
    assert health == sorted(health, reverse=True)
    assert answer["counts"] == {name: int((table.health == k).sum()) for k, name in enumerate(HEALTH_NAMES)}
    assert [*answer["counts"]] == [*HEALTH_NAMES[::-1]]
    by_value = api.rows(first=5, count=7, sort="temperature", down=False)
    wanted = [names[k] for k in np.argsort(table.mean[:, 0])][5:12]
    assert [row["asset"] for row in by_value["rows"]] == wanted and by_value["first"] == 5
    assert [row["values"][0] for row in by_value["rows"]] == pytest.approx(np.sort(table.mean[:, 0])[5:12], rel=1e-5)
    assert [row["asset"] for row in api.rows(sort="asset", down=False)["rows"]] == sorted(names)[:50]
    assert api.rows(version=answer["version"]) == {"version": answer["version"]}


def test_assets_are_found_by_words_and_health(running):
    api = FleetApi(running)
    found = api.rows(find="PUMP 1", count=60)
    assert {row["asset"] for row in found["rows"]} == {f"pump {k}" for k in range(60) if "1" in str(k)}
    assert found["found"] == 15 and found["assets"] == 60
    worst = api.rows(health="stale", count=60)
    assert [row["asset"] for row in worst["rows"]] == [] or {row["health"] for row in worst["rows"]} == {"stale"}
    assert sum(api.rows(health=name)["found"] for name in HEALTH_NAMES) == 60
    assert api.rows(first=1000)["rows"] == [] and api.rows(count=10**9)["found"] == 60


def test_assets_that_differ_from_the_others_are_told(running):
    _, names, table = running.table()
    mean = table.mean.copy()
    mean[7, 0] += 40.0
    api, known = FleetApi(running), siblings(mean[:, 0], table.std[:, 0])
    changed = table._replace(mean=mean)
    shown = SimpleNamespace(table=lambda: (running.table()[0] + 1, names, changed), plan=running.plan, ended=True,
                            failure="", counts={})  # fmt: skip
    answer = FleetApi(shown).rows(differs=True)
    wanted = {names[k] for k in np.flatnonzero(known.differs)}
    assert {row["asset"] for row in answer["rows"]} == wanted and names[7] in wanted
    assert answer["found"] == answer["siblings"]["differ"] == len(wanted) < answer["assets"] == 60
    assert answer["siblings"]["mean"] == pytest.approx(known.mean, rel=1e-5)
    assert answer["siblings"]["std"] == pytest.approx(known.std, rel=1e-5)
    assert api.rows(column="nis")["siblings"] is None and api.rows(column="nis", differs=True)["rows"] == []


def test_histograms_count_every_asset(running):
    answer = FleetApi(running).rows(column="rate_std")
    _, _, table = running.table()
    assert sum(answer["histogram"]["counts"]) == 60
    assert answer["histogram"]["low"] >= table.std[:, 1].min() and answer["histogram"]["high"] <= table.std[:, 1].max()


@pytest.mark.parametrize(
    ("query", "text"),
    [({"sort": "temp"}, "sort is 'temp'"), ({"column": "x"}, "column is 'x'"), ({"health": "bad"}, "health is 'bad'")],
)
def test_a_wrong_query_is_one_line(running, query, text):
    with pytest.raises(ConfigError, match=text):
        FleetApi(running).rows(**query)


def test_metrics_have_a_series_for_each_health_and_none_for_an_asset(running):
    text = FleetApi(running).metrics().body.decode()
    found = re.findall(r'nisus_fleet_assets{fleet="pumps",health="(\w+)"} (\S+)', text)
    counts = {name: int(float(number)) for name, number in found}
    assert counts == FleetApi(running).rows()["counts"] and sum(counts.values()) == 60
    events = float(running.table()[2].events.sum())
    assert "pump 1" not in text and f'nisus_fleet_events_total{{fleet="pumps"}} {events}' in text


def test_ids_of_assets_are_one_part_of_a_path(running):
    api = FleetApi(running)
    assert id_of("pump 3", 3) == "pump 3" and id_of("hall/pump", 7) == "@7" and id_of("..", 1) == "@1"
    assert api.find("pump 3") == "pump 3" and api.find("@7") == running.names[7]
    assert api.find("pump 99") is None and api.find("@99") is None


@contextmanager
def served(folder, *options):
    """The address of a served fleet, and a function that sends a request and returns the answer's body."""
    run = subprocess.Popen(
        [sys.executable, "-m", "app.cli.main", "fleet", "pumps.yaml", "--port", "0", *options],
        cwd=folder, text=True, stdout=subprocess.PIPE, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    try:
        assert run.stdout is not None
        address = re.compile(r"http://127.0.0.1:\d+/\?token=\S+")
        url = next(found.group() for line in run.stdout if (found := address.search(line)))
        site, _, token = url.partition("/?token=")
        headers, opener = {"Authorization": f"Bearer {token}"}, build_opener(ProxyHandler({}))

        def ask(path, messages=None):
            body = None if messages is None else json.dumps(messages).encode()
            request = Request(f"{site}{path}", body, headers | {"Content-Type": "application/json"})
            with opener.open(request, timeout=LIMIT_S) as answer:
                return json.loads(answer.read())

        yield url, ask
    finally:
        run.terminate()
        run.wait(LIMIT_S)
        run.stdout.close()


@pytest.fixture(scope="module")
def overview(fleet):
    """The address of the overview of a served fleet."""
    with served(fleet) as (url, _):
        yield url


def test_the_page_lists_the_worst_first_and_a_click_opens_the_history_of_an_asset(fleet, browser):
    with served(fleet) as (url, ask):
        page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(url)
        expect(page.locator("#rows a").first).to_be_visible(timeout=LIMIT_S * 1e3)
        expect(page.locator("#state")).to_contain_text("source has ended")
        assert page.locator("#rows a").count() < 60  # those in view
        page.fill("#find", "pump 31")
        expect(page.locator("#rows a")).to_have_count(1)
        page.locator("#rows a").click()
        page.wait_for_url("**/twins/pump%2031/")
        expect(page.locator("#trust")).to_contain_text("pump_31")
        assert ask("/twins/pump%2031/api/state")["twin"] == "pump_31"
        # The scripts are those of the overview: a browser fetches them once, not for each asset.
        loaded = page.evaluate("performance.getEntriesByType('resource').map((one) => new URL(one.name).pathname)")
        scripts = [path for path in loaded if path.endswith((".js", ".css"))]
        assert "/page/page.js" in scripts and all(path.startswith("/page/") for path in scripts)
        assert errors == []


@pytest.mark.parametrize("width", [1440, 1000, 700])
def test_the_overview_is_within_its_bounds_at_any_width(width, fleet, browser, overview):
    page = browser.new_context(viewport={"width": width, "height": 800}).new_page()
    page.goto(overview)
    expect(page.locator("#rows a").first).to_be_visible()

    def box(selector):
        found = page.locator(selector).bounding_box()
        return found["x"], found["y"], found["x"] + found["width"], found["y"] + found["height"]

    left, top, right, bottom = box("#trust")
    for item in ("#find", "#theme", "#place"):
        x, y, end, below = box(item)
        assert left <= x and end <= right and top <= y and below <= bottom, item
    edges = {  # of the headings, and of the cells of the first row
        place: page.locator(f"{place} > *").evaluate_all(
            "all => all.map((e) => e.getBoundingClientRect()).map((b) => b.width ? [b.left, b.right] : [])"
        )
        for place in ("#heads", "#rows a:first-child")
    }  # fmt: skip
    heads, cells = edges.values()
    shown = [k for k, edge in enumerate(heads) if edge]
    assert shown == [k for k, edge in enumerate(cells) if edge] and {0, 1} < {*shown}
    for k in shown:
        assert heads[k][0] == cells[k][0] or heads[k][1] == cells[k][1]  # texts at the left, numbers at the right
    ends = [heads[k] for k in shown]
    assert all(one[1] <= next_one[0] for one, next_one in itertools.pairwise(ends)) and ends[-1][1] <= width
    assert page.locator("aside").evaluate("node => node.scrollHeight <= node.clientHeight")


def test_a_click_opens_an_asset_of_messages_from_the_archive(tmp_path, browser):
    (tmp_path / "pumps.yaml").write_text("{twin: motor_winding, source: {type: push}}")
    begin, rows = 1_767_225_600 * 10**9, pump_rows(count=60)
    with served(tmp_path, "--archive", "archive") as (url, ask):
        sent = [{"time": begin + round(t * 1e9), "asset": name, "values": {"winding": y}} for t, name, y in rows]
        assert ask("/api/readings", sent)["accepted"] == len(sent)
        archive = tmp_path / "archive" / "pumps"
        wait_for(lambda: (found := AssetHistory(archive, "pump 3").read(1000)) is not None and found.num_rows >= 60)
        page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()
        page.goto(url)
        page.get_by_role("row", name="pump 3").click()
        page.wait_for_url("**/twins/pump%203/")
        expect(page.locator("#trust")).to_contain_text("pump_3")

        def state(accepted):
            found = ask("/twins/pump%203/api/state")
            return found["sensors"][0]["accepted"] >= accepted and found

        at_60 = wait_for(lambda: state(60))
        last = max(item["time"] for item in sent)
        assert at_60["time_ns"] >= max(item["time"] for item in sent if item["asset"] == "pump 3")
        more = [{"time": last + 10**9, "asset": "pump 3", "values": {"winding": 40.0}}]
        assert ask("/api/readings", more)["accepted"]
        assert wait_for(lambda: state(61))["time_ns"] >= last + 10**9  # the open page follows
    assert parts_of(archive) and not [*(tmp_path / "archive").glob("*/*.arrows")]
