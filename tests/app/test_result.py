"""Results as text, HTML and JSON from one description; times of a log in words."""

import json
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest

from app.format_time import counted, format_time
from app.render.html import to_html
from app.render.text import MAX_TABLE_WIDTH, WIDTH, to_text
from app.result import Figure, TableColumn, Topic, number_text, to_json


def test_wide_rows_become_paragraphs_whose_short_cells_keep_their_heading():
    note = "why it was kept " * 12
    head = ("version", "saved", "filter", "NIS", "note")
    narrow = to_text([Topic("Versions", (), head, (("a", "today", "kf", "0.95", "short"),))]).splitlines()
    assert narrow[1].split() == list(head) and narrow[2].split() == ["a", "today", "kf", "0.95", "short"]
    two = (*head, "reason")
    rows = (("a", "today", "kf", "0.95", note, note), ("b", "-", "ekf", "-", note, ""))
    wide = to_text([Topic("Versions", (), two, rows)]).splitlines()
    assert wide[1:3] == ["  a today", "      filter kf, NIS 0.95"]
    assert "      filter ekf" in wide and max(map(len, wide)) <= WIDTH
    assert " ".join(" ".join(wide).split()).count("why it was kept") == 36


def test_a_long_last_cell_is_wrapped_below_itself():
    rows = (("kf", "because it is not linear " * 12), ("ekf", "yes"))
    lines = to_text([Topic("Filters", (), ("name", "applies"), rows)]).splitlines()
    assert lines[1].split() == ["name", "applies"] and lines[2].startswith("  kf    because")
    assert lines[3].startswith("        ") and lines[-1] == "  ekf   yes"
    assert max(map(len, lines)) <= MAX_TABLE_WIDTH and " ".join(lines).count("because") == 12


@pytest.mark.parametrize(
    "value, decimals, scale, text",
    [(1.23456, None, 1.0, "1.23"), (2283.4, None, 1.0, "2,280"), (1e-7, None, 1.0, "1e-07"), (0.5, 1, 100.0, "50.0"),
     (12345, None, 1.0, "12,345"), (np.int64(3), None, 1.0, "3"), (np.nan, 3, 1.0, "-"), (None, None, 1.0, "-"),
     (True, None, 1.0, "yes"), ("as it is", 3, 1.0, "as it is"), (np.inf, None, 1.0, "inf")],
)  # fmt: skip
def test_numbers_have_the_digits_that_matter(value, decimals, scale, text):
    assert number_text(value, decimals, scale) == text


def test_numbers_are_aligned_to_the_right_and_missing_ones_are_dashes():
    columns = ("name", TableColumn("share [%]", decimals=1, scale=100.0), "n")
    topic = Topic("Shares", ("One sentence.",), columns, (("a", 0.05, 7), ("b", np.nan, 1200)))
    assert to_text([topic, Topic("End", figures=(Figure("gain", 0.12345, "K", "on 3 logs"),))]).splitlines() == [
        "Shares",
        "  One sentence.",
        "  name  share [%]      n",
        "  a           5.0      7",
        "  b             -  1,200",
        "",
        "End",
        "  gain  0.123 K   on 3 logs",
    ]
    html = to_html("page", [topic, Topic("End", figures=(Figure("gain", 0.12345, "K"),))], now=0.0)
    assert "1 January" in html.replace("01 January", "1 January") and ">1,200</td>" in html and ">0.123 K</td>" in html


class Pair(NamedTuple):
    low: float
    high: float


@dataclass(frozen=True)
class Outer:
    name: str
    pair: Pair
    values: np.ndarray


def test_json_has_objects_for_named_tuples_and_null_for_what_is_no_number():
    found = to_json(
        {"a": Outer("x", Pair(np.nan, 2.0), np.array([1.0, np.inf])), 3: (np.bool_(True), np.int32(4), None)}
    )
    assert json.loads(found, parse_constant=pytest.fail) == {
        "a": {"name": "x", "pair": {"low": None, "high": 2.0}, "values": [1.0, None]},
        "3": [True, 4, None],
    }


@pytest.mark.parametrize(
    ("t", "said"),
    [(61 * 10**9, "61 s"), (1_795_358_420_700_000_000, "2026-11-22 14:40:20 UTC"), (10**18 - 10**9, "1e+09 s")],
)
def test_a_time_has_a_date_where_its_clock_counts_from_1970(t, said):
    assert format_time(t) == said


@pytest.mark.parametrize(
    "number, text", [(0, "0 readings"), (1, "1 reading"), (2, "2 readings"), (1200, "1,200 readings")]
)
def test_a_count_has_the_number_of_its_noun(number, text):
    assert counted(number, "reading") == text
