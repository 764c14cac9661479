"""Measurements by POST: the state of the fold of the same log, an answer for each, and nothing taken twice."""

import json
import time

import numpy as np
import pyarrow as pa
import pytest

from app.twin.twin import load_twin
from estimators import fold
from sources.messages import Messages, SentNumbers
from sources.source import Accuracy, Channel, Condition, ignore
from sources.tables.text import TextMatch
from tests.app.served import ServedEngine
from tests.cases import cases
from tests.support import SECOND, measured
from tests.waiting import LIMIT_S, wait_for

BEGIN = 1_767_225_600 * SECOND  # 2026-01-01T00:00:00Z
JSON, LINES, ARROW = "application/json", "application/x-ndjson", "application/vnd.apache.arrow.stream"


def opened():
    # Without rows of predictions: the newest row is that of the newest measurement.
    twin = load_twin("motor_winding", overrides={"source": "{type: push}", "time.predict_every": "1000"})
    served = ServedEngine(twin=twin, behind=lambda _: twin.open_source(ignore))
    with pytest.MonkeyPatch.context() as patch:
        # On a busy machine, too, an answer says what became of its messages.
        patch.setattr("app.web.readings.OUTCOME_TIMEOUT_S", LIMIT_S)
        yield served
    served.stop()


page = pytest.fixture(opened)
shared = pytest.fixture(opened, scope="module")
"""For tests whose order does not matter: each sends what is newer than all before, or nothing that is taken."""


def sent(page, body, kind=JSON):
    headers = [("Host", page.client.host), ("Cookie", page.client.cookie), ("Content-Type", kind)]
    body = body if isinstance(body, bytes) else json.dumps(body).encode()
    answer = page.client.raw("POST", "/api/readings", [*headers, ("Origin", page.client.origin)], body)
    return answer.status, json.loads(answer.text) if answer.headers["content-type"] == JSON else answer.text


def message(k, value, **more):
    return {"time": BEGIN + k * SECOND, "values": {"winding": value}, **more}


def accepted(index, became):
    return {"index": index, "status": "accepted", "became": became}


def test_the_published_state_is_that_of_the_fold_whatever_the_form(page):
    values = (40.0 + np.random.default_rng(1).normal(0.0, 2.0, 40)).tolist()
    assert sent(page, message(0, values[0])) == (
        200,
        {"accepted": 1, "duplicate": 0, "refused": 0, "items": [accepted(0, "used")], "stored": False},
    )
    iso = [{"time": f"2026-01-01T01:00:{k:02d}+01:00", "values": {"winding": values[k]}} for k in range(1, 10)]
    assert sent(page, iso)[1]["accepted"] == 9
    lines = "\n".join(json.dumps(message(k, values[k])) for k in range(10, 20)).encode()
    assert sent(page, lines, LINES)[1]["accepted"] == 10
    for times in (
        pa.array([BEGIN + k * SECOND for k in range(20, 30)]),
        pa.array([(BEGIN + k * SECOND) // 10**6 for k in range(30, 40)], pa.timestamp("ms", tz="UTC")),
    ):
        first = 20 if pa.types.is_integer(times.type) else 30
        body = arrow({"time": times, "winding": values[first : first + 10]})
        assert sent(page, body, ARROW)[1]["accepted"] == 10
    twin = page.engine.twin
    log = measured(twin.model, "winding", BEGIN * 1e-9 + np.arange(40.0), values, start=BEGIN * 1e-9)
    track = fold(twin.estimator, twin.model, log, tuning=twin.tuning)
    wait_for(lambda: page.get("/api/state")["time_ns"] == BEGIN + 39 * SECOND)
    (temperature, rate) = page.get("/api/state")["states"]
    assert [temperature["value"], rate["value"]] == track.mean[-1].tolist()
    assert [temperature["std"], rate["std"]] == track.std[-1].tolist()
    wait_for(lambda: page.rows() == 40)


@cases(__file__, "refused_messages.csv")
def test_each_message_has_its_answer_and_a_wrong_one_does_not_hold_up_the_others(shared, wrong, reason):
    before = shared.rows()
    wrong = json.loads(wrong.replace("BEYOND", f"1{400 * '0'}"))
    status, found = sent(shared, [wrong, message(before + 10, 41.0), wrong, message(before + 11, 41.0)])
    assert (status, found["accepted"], found["refused"]) == (200, 2, 2)
    for item in found["items"][::2]:
        assert item["status"] == "refused" and reason in item["reason"] and "\n" not in item["reason"]
    assert found["items"][1::2] == [accepted(1, "used"), accepted(3, "used")]
    wait_for(lambda: shared.rows() == before + 2)


def test_a_message_that_was_sent_before_is_taken_once(page):
    batch = [message(100 + k, 42.0, source="plc", sequence=k) for k in range(5)]
    assert sent(page, batch)[1]["accepted"] == 5
    again = sent(page, [*batch[::-1], message(105, 42.0, source="plc", sequence=5)])[1]
    assert (again["accepted"], again["duplicate"]) == (1, 5)
    assert [item["status"] for item in again["items"]] == ["duplicate"] * 5 + ["accepted"]
    other = sent(page, message(106, 42.0, source="gateway", sequence=5))[1]
    assert other["accepted"] == 1
    wait_for(lambda: page.rows() == 7)


def test_null_is_a_dropout(page):
    assert sent(page, message(107, None))[1]["items"] == [accepted(0, "unused")]
    wait_for(lambda: page.get("/api/state")["sensors"][0]["dropouts"] == 1)


def test_an_answer_says_what_became_of_a_message(page):
    horizon, ahead = page.engine.twin.config.time.max_delay, {"time": time.time_ns() + 3600 * SECOND}
    late, stale = (message(110 - factor * horizon, 42.0) for factor in (0.5, 2.0))
    for item in (late, stale):
        item["time"] = int(item["time"])
    items = sent(page, [message(110, 42.0), late, stale, message(111, 42.0) | ahead])[1]["items"]
    assert [item["became"] for item in items] == ["used", "late", "stale", "waiting"]


def test_measurements_that_are_old_when_they_arrive_have_their_age(page):
    begin = time.time_ns() - 3600 * SECOND
    sent(page, [{"time": begin + k * SECOND, "values": {"winding": 40.0}} for k in range(40)])
    found = wait_for(lambda: (state := page.get("/api/state"))["time_ns"] == begin + 39 * SECOND and state)
    assert 3561 <= found["age_s"] < 4000 and found["health"] == "degraded" and found["estimate_valid"]
    assert found["cause"].endswith("s old when they arrive")
    status = wait_for(lambda: (last := page.engine.status()).t == begin + 39 * SECOND and last)
    assert status.sensors == {"winding": ("degraded", status.cause)} and status.since <= begin
    sent(page, {"values": {"winding": 40.0}})
    found = wait_for(lambda: (state := page.get("/api/state"))["time_ns"] > begin + 3600 * SECOND and state)
    assert found["age_s"] < 400 and "old when" not in found["cause"]


@pytest.mark.parametrize(
    ("body", "kind", "status", "text"),
    [
        (b"{", JSON, 400, "the body is no JSON; send one message, a list of them, or lines as NDJSON"),
        (b"[" * 100_000, JSON, 400, "the body is no JSON"),
        (b"arrow", ARROW, 400, "the body is no stream of Arrow batches"),
        (b"winding", "text/plain", 415, "Content-Type must be one of application/json, application/x-ndjson"),
        (b" " * (8 * 2**20 + 1), JSON, 413, "a body may have 8 MB and 100,000 messages; send fewer"),
    ],
)
def test_a_body_that_cannot_be_read_is_refused_in_one_line(shared, body, kind, status, text):
    found, answer = sent(shared, body, kind)
    assert found == status and text in str(answer) and str(answer).strip().count("\n") == 0


def arrow(columns, compression=None):
    """The body of a stream of one batch."""
    batch = pa.record_batch(columns)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, batch.schema, options=pa.ipc.IpcWriteOptions(compression=compression)) as stream:
        stream.write_batch(batch)
    return sink.getvalue().to_pybytes()


def test_a_small_body_is_no_large_work_and_reads_no_memory_of_others(page):
    bounds = "Nisus: a body may have 8 MB and 100,000 messages; send fewer messages at once.\n"
    for body, kind in ((b"[" + b"1," * 100_000 + b"1]", JSON), (b"1\n" * 100_001, LINES)):
        assert sent(page, body, kind) == (413, bounds)
    body = arrow({"winding": pa.nulls(100_001)})
    assert len(body) < 1000 and sent(page, body, ARROW) == (413, bounds)
    for compression in ("lz4", "zstd"):
        status, found = sent(page, arrow({"winding": np.zeros(1000)}, compression), ARROW)
        assert (status, found) == (400, {"error": "the batches are compressed; send them without compression"})
    for column in (
        pa.array([[1.0]]),
        pa.array(["Good"]).dictionary_encode(),
        pa.array(["Good"]).cast(pa.string_view()),
    ):
        status, found = sent(page, arrow({"winding": column}), ARROW)
        assert status == 400 and "column winding is of type " in found["error"]
    # More rows than the buffer has.
    honest = arrow({"winding": np.ones(7777)})
    rows = (7777).to_bytes(8, "little")
    assert honest.count(rows) == 2
    status, found = sent(page, honest.replace(rows, (90_000).to_bytes(8, "little")), ARROW)
    assert status == 400 and "expected at least 720000 byte(s)" in found["error"]
    whole = arrow({"winding": np.ones(2)})
    for place in range(0, len(whole), 3):
        damaged = bytearray(whole)
        damaged[place] ^= 0xFF
        status, found = sent(page, bytes(damaged), ARROW)
        # A value may have changed, or the columns: then each message is refused.
        assert (status == 400 and "\n" not in found["error"]) or (status == 200 and len(found["items"]) <= 2)


def test_a_line_that_is_no_json_is_refused_alone(page):
    body = b'{"values": {"winding": 40}\n' + json.dumps(message(108, 40.0)).encode()
    assert [item["status"] for item in sent(page, body, LINES)[1]["items"]] == ["refused", "accepted"]


def test_names_and_units_are_told(shared):
    assert shared.get("/api/readings") == {"values": [{"name": "winding", "unit": "°C"}]}


def test_a_twin_with_another_source_says_so(serve):
    status, found = sent(serve(twin=load_twin("motor_winding")), message(0, 1.0))
    assert status == 409
    assert found["error"].endswith("is of type simulator; only one of type push takes messages")


def test_units_conditions_and_words_of_quality_are_those_of_a_table():
    keys: list[str] = []
    channels = [
        Channel(
            0, 0, "level", ("LT101",), units=("mm",), model_units=("m",), scale=(2.0,), accuracy=Accuracy(("s",)),
            where=(Condition(TextMatch("quality", ("Good",)), 1.0, 1.0),),
        ),
    ]  # fmt: skip
    source = Messages(channels, width=1, report=lambda key, _: keys.append(key))
    assert source.names == ("LT101", "s", "quality")
    columns = [1500] * 3 + ["I/O Timeout"], [0.5, 0.5, "Bad", 1], ["Good", "Bad", "Good", "Good"]
    messages = [{"values": dict(zip(source.names, row, strict=True))} for row in zip(*columns, strict=True)]
    assert {answer.status for answer in source.send(messages)} == {"accepted"}
    np.testing.assert_array_equal(source.read(0.0).value[:, 0], [3.0, *[np.nan] * 3])
    assert {"unknown accuracy level", "no value s: Bad", "no value LT101: I/O Timeout"} < set(keys)
    assert len(source.read(0.0)) == 0


def test_what_waits_and_what_is_remembered_is_bounded(monkeypatch):
    monkeypatch.setattr("sources.messages.MAX_WAITING", 3)
    source = Messages([Channel(0, 0, "level", ("LT101",), model_units=("m",))], width=1)
    statuses = [answer.status for answer in source.send([{"values": {"LT101": k}} for k in range(5)])]
    assert statuses == ["accepted"] * 3 + ["refused"] * 2
    assert len(source.read(0.0)) == 3
    assert source.send([{"values": {"LT101": 1.0}}])[0].status == "accepted"
    monkeypatch.setattr("sources.messages.MAX_WAITING", 10**6)
    monkeypatch.setattr("sources.messages.MAX_GAPS", 3)
    monkeypatch.setattr("sources.messages.MAX_SENDERS", 2)
    sent = SentNumbers()
    assert [sent.add("a", k) for k in (5, 7, 6, 5, 10, 20, 30)] == [True, True, True, False, True, True, True]
    # Those of a gap that is forgotten count as duplicates too.
    assert sent.state() == {"a": [[5, 10], [20, 20], [30, 30]]}
    assert [sent.add(name, 8) for name in "abca"] == [False, True, True, True]


def test_sequence_numbers_are_those_of_a_set():
    numbers = np.random.default_rng(4).integers(0, 300, 1000).tolist()
    sent, known = SentNumbers(), set()
    for number in numbers:
        assert sent.add("", number) == (number not in known)
        known.add(number)
    ranges = sent.state()[""]
    assert [k for first, last in ranges for k in range(first, last + 1)] == sorted(known)
    assert all(last + 1 < first for (_, last), (first, _) in zip(ranges, ranges[1:], strict=False))
