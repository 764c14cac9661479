"""`nisus push`: lines of CSV and NDJSON at the API of a running twin, and the wrong ones named."""

import io
import json

import pytest

from app.extensions.push.command import RowReader
from tests.app.web.test_readings_api import BEGIN, message, opened
from tests.cases import cases
from tests.support import SECOND
from tests.waiting import wait_for

page = pytest.fixture(opened)
shared = pytest.fixture(opened, scope="module")
"""For tests of which nothing is taken."""


def pushed(page, nisus, monkeypatch, text, *options):
    """What `nisus push` says of these lines, and the number of readings that they gave."""
    before = page.rows()
    monkeypatch.setattr("sys.stdin", io.StringIO(text))
    said = nisus.run("push", page.server.url, "--json", *options)
    counts = json.loads(said.out)
    wait_for(lambda: page.rows() == before + counts["accepted"])
    return counts, said.err


def test_lines_of_csv_are_sent_and_the_wrong_ones_named(page, nisus, monkeypatch):
    rows = [f"{BEGIN // 10**9 + 110 + k}.5,{40 + k},x" for k in range(5)]
    text = "\n".join(["t,winding,other", *rows, "yesterday,40,x", f"{BEGIN // 10**9 + 115},hot,x", ""])
    counts, said = pushed(page, nisus, monkeypatch, text, "--time", "t", "--source", "plant")
    assert counts == {"accepted": 5, "duplicate": 0, "refused": 2}
    first, second = said.splitlines()
    assert "line 7: time is 'yesterday'; it must be ISO 8601" in first
    assert "line 8: winding is hot; it must be a number" in second
    assert page.get("/api/state")["time_ns"] == BEGIN + 114 * SECOND + SECOND // 2
    assert pushed(page, nisus, monkeypatch, text, "--time", "t", "--source", "plant")[0] == {
        "accepted": 0, "duplicate": 5, "refused": 2,
    }  # fmt: skip


def test_lines_of_ndjson_are_sent_and_the_wrong_ones_named(page, nisus, monkeypatch):
    text = "\n".join([json.dumps(message(120 + k, 41.0)) for k in range(3)] + ["{", "", json.dumps(message(123, 41.0))])
    counts, said = pushed(page, nisus, monkeypatch, text)
    assert counts == {"accepted": 4, "duplicate": 0, "refused": 1}
    assert said.count("\n") == 1 and "line 4: it must be an object with values" in said


@cases(__file__, "refused_pushes.csv")
def test_push_says_what_is_wrong_with_address_and_columns(shared, nisus, monkeypatch, url, lines, text):
    monkeypatch.delenv("NISUS_URL", raising=False)
    monkeypatch.setattr("sys.stdin", io.StringIO(lines))
    given = [] if not url else [url.format(host=shared.client.origin, url=shared.server.url)]
    assert text in nisus.refuses("push", *given, *(["--time", "tme"] if "tme" in text else []))


def test_a_mark_of_the_byte_order_is_no_letter_and_a_line_without_end_is_refused_alone(page, nisus, monkeypatch):
    begin = BEGIN // SECOND + 130
    text = f"\ufefft,winding\n{begin},41.0\n{'x' * 200_000}\n{begin + 1},41.5\n"
    counts, said = pushed(page, nisus, monkeypatch, text, "--time", "t")
    assert counts == {"accepted": 2, "duplicate": 0, "refused": 1}
    assert said.count("\n") == 1 and "line 3: it must be an object with values" in said


def test_lines_that_come_together_are_sent_together():
    rows = RowReader(io.StringIO("time,a\n" + "".join(f"{k},{k}\n" for k in range(2500))), {"a"}, "time", 1, "here")
    batches = list(rows.batches())
    assert sum(len(messages) for _, messages in batches) == 2500 and len(batches[0][0]) == 1999
    assert batches[0][1][1] == {"source": "here", "sequence": 3, "values": {"a": 1.0}, "time": 1}
