"""Faults over the API: put into the running source, listed, stamped, ended; what cannot be is one line."""

import json

import pytest

from app.web.commands_json import command_from_json
from estimators.errors import NisusError
from estimators.log import MARK, READING
from sources.faults.kinds import KINDS
from sources.faults.layer import Faults, FaultySource
from tests.app.scripted import MODEL, notice_texts, pull_all, readings
from tests.app.web.test_bounds import NASTY
from tests.cases import cases
from tests.support import SECOND
from tests.waiting import wait_for


@pytest.fixture
def page(serve):
    """Of a source that takes faults, after one measurement."""
    page = serve(behind=lambda source: FaultySource(source, Faults(MODEL)))
    page.source.put(readings([1.0], [40.0]))
    wait_for(lambda: page.rows() == 1)
    return page


def ask(page, **body):
    return page.client.post("/api/command", body)


def active(page):
    return page.get("/api/status")["faults"]


def test_a_fault_begins_and_ends_by_command(page):
    assert active(page) == []
    assert ask(page, command="InjectFault", kind="bias", target="winding", size=2.5).status == 202
    wait_for(lambda: len(active(page)) == 1)
    page.source.put(readings([2.0, 3.0], [40.0, 41.0]))
    wait_for(lambda: page.rows() == 3)
    wait_for(lambda: active(page)[0]["touched"] == 2)
    (told,) = active(page)
    assert told == {
        "number": 0, "kind": "bias", "target": "winding", "text": "bias of winding, size 2.5 °C",
        "since": told["since"], "touched": 2, "lost": 0,
    }  # fmt: skip
    assert told["since"] == 2_000_000_000
    assert ask(page, command="ClearFault", number=0).status == 202
    wait_for(lambda: active(page) == [])
    page.source.put(readings([4.0], [42.0]))
    wait_for(lambda: page.rows() == 4)
    events = pull_all(page.engine).events
    code = KINDS["bias"].code
    assert [(t / 1e9, value) for t, value in zip(events.t, events.value[:, 0])] == [
        (1.0, 40.0), (2.0, 42.5), (2.0, code), (3.0, 43.5), (4.0, 42.0), (4.0, -code),
    ]  # fmt: skip
    assert events.kind.tolist() == [READING, READING, MARK, READING, READING, MARK]
    said = notice_texts(page.engine)
    assert "fault 0 begins: bias of winding, size 2.5 °C" in said and "1 fault(s) end" in said


def test_all_end_together_and_what_is_swallowed_is_counted(page):
    assert ask(page, command="InjectFault", kind="silence").status == 202
    assert ask(page, command="InjectFault", kind="stuck", target="winding", duration=60).status == 202
    wait_for(lambda: len(active(page)) == 2)
    page.source.put(readings([2.0, 3.0], [40.0, 41.0]))
    wait_for(lambda: page.get("/api/status")["counts"].get("silenced") == 2)
    assert ask(page, command="ClearFault").status == 202
    wait_for(lambda: active(page) == [])


def test_the_catalogue_says_what_a_kind_takes(page):
    found = page.get("/api/faults")
    assert found["available"] and found["sensors"] == {"winding": [{"name": "winding", "unit": "°C"}]}
    kinds = {kind["name"]: kind for kind in found["kinds"]}
    # The scripted source is no asset whose parameters could change.
    assert set(kinds) == set(KINDS) - {"model"}
    assert kinds["spike"]["parameters"][1] == {
        "name": "rate", "unit": "1", "help": "probability for each measurement", "default": None,
    }  # fmt: skip


@cases(__file__, "refused_faults.csv")
def test_a_fault_that_cannot_be_is_one_line(page, body, says):
    answer = ask(page, command="InjectFault", **json.loads(body))
    assert answer.status == 400
    text = json.loads(answer.text)["error"]
    assert says in text and "\n" not in text


def test_ending_a_fault_that_there_is_not_is_one_line(page):
    answer = ask(page, command="ClearFault", number=4)
    assert answer.status == 400 and "number is 4; there is no such fault" in answer.text


def test_nothing_that_is_asked_for_stops_the_source(page):
    taken = 0
    for kind in [*KINDS, "outliers"]:
        for target in (None, "winding"):
            for field in ("size", "rate", "every", "count", "duration", "row", "other"):
                for value in NASTY:
                    body = {"command": "InjectFault", "kind": kind, "target": target, "size": 1e3, field: value}
                    try:
                        page.engine.submit(command_from_json(body, page.engine))
                    except NisusError as error:
                        assert str(error).startswith("InjectFault: ")
                        continue
                    taken += 1
    assert taken > 100
    page.source.put(readings([2.0, 3.0], [40.0, 41.0]))
    ask(page, command="ClearFault")
    wait_for(lambda: active(page) == [])
    page.source.put(readings([4.0], [42.0]))

    def taken_at(seconds):
        events = pull_all(page.engine).events
        return events.value[(events.kind == READING) & (events.t == int(seconds * SECOND)), 0].tolist()

    # Those before it may come late: the faults of their time delay, repeat and withhold.
    wait_for(lambda: taken_at(4.0) == [42.0])
    counts = page.get("/api/status")["counts"]
    assert not counts.get("engine error") and not counts.get("source failed")


def test_a_recording_takes_no_faults(serve):
    page = serve()
    answer = ask(page, command="InjectFault", kind="stuck", target="winding")
    assert answer.status == 400 and "review of a recording" in answer.text
    assert not page.get("/api/faults")["available"]
