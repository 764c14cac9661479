"""`nisus check`: its figures, its page as text and as HTML."""

import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from app.cli.main import main
from app.render.html import to_html
from app.result import Bar, Topic
from estimators.diagnostics.sensitivity.responses import Nudge

REQUIRED = {"checklist", "observability", "smallest_visible", "integrity", "held_out", "open_loop"}
MORE = set("twin estimator span timing calibration posterior linearity dimension repeats health".split())

QUESTIONS = ["linearity", "dimension", "posterior", "observability", "timing", "health", "tuning", "change"]


VOID = ("meta", "br", "hr", "img", "link", "input")


class ParsedHtml(HTMLParser):
    """Tags, attributes and text of HTML in which every tag must be closed."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str | None]] = []
        self.tags, self.text = set[str](), list[str]()
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes += [(tag, name, value) for name, value in attrs]
        self.open += [tag] if tag not in VOID else []

    def handle_endtag(self, tag):
        assert tag in VOID or self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    """JSON, HTML of the smallest twin."""
    html = tmp_path_factory.mktemp("check") / "check.html"
    with pytest.MonkeyPatch.context() as patch:
        printed: list[str] = []
        patch.setattr("builtins.print", lambda *words, **_: printed.append(" ".join(map(str, words))))
        assert main(["check", "motor_winding", "--json", "--html", str(html)]) == 0
    return json.loads(printed[-1]), html.read_text(encoding="utf-8")


def test_keys_are_those_that_scripts_read(checked):
    found, _ = checked
    assert set(found) == REQUIRED | MORE
    assert list(found["checklist"]) == QUESTIONS
    for key, line in found["checklist"].items():
        assert set(line) == {"key", "question", "answer", "figures", "remedy"} and line["key"] == key
        assert line["answer"] in ("yes", "partly", "no", "not told") and line["figures"]


def test_figures_agree_with_each_other(checked):
    found, _ = checked
    assert found["integrity"]["reason"] == ""
    faults = {(fault["kind"], fault["name"]): fault for fault in found["smallest_visible"]}
    assert set(faults) == {
        *((kind, "winding") for kind in ("sensor", "scale", "R", "drift", "delay", "spikes", "stuck")),
        *((kind, state) for kind in ("prior", "Q") for state in ("temperature", "rate")),
    }
    # One sensor alone: its reading 10 % too high is the temperature of a hotter motor.
    assert not faults["scale", "winding"]["seen"] and faults["scale", "winding"]["high"] == 0.5
    states = found["integrity"]["states"]
    assert set(states) == {"temperature", "rate"}
    for state in states.values():
        assert state["bound"] == pytest.approx(state["bias"] + state["two_sigma"], rel=1e-9)
    held = found["held_out"]["winding"]
    # The only sensor: without it nothing is left but the model.
    assert held["rms"] == held["open_loop"] == found["open_loop"]["sensors"]["winding"]["rms"]
    assert set(held["coverage"]) == {"50", "90", "95"}
    # The YAML says what to expect of the filter: 1.04 °C.
    truth = found["open_loop"]["states"]["temperature"]
    assert truth["filter"] == pytest.approx(1.04, abs=0.005)
    assert truth["rms"] > 10.0 and truth["worse"] is False
    assert found["linearity"]["exact"] and found["linearity"]["passes"]
    assert found["observability"]["whole"]["rank"] == 2
    # One in 15 readings is lost, the last of them among these.
    assert found["timing"]["sensors"]["winding"]["n"] == 112
    assert sum(found["health"]["share"].values()) == pytest.approx(1.0)


def test_html_is_one_file_without_scripts(checked):
    _, html = checked
    page = ParsedHtml(html)
    assert not page.tags & {"script", "link", "iframe", "img", "object", "embed", "form", "input"}
    for tag, name, value in page.attributes:
        assert name not in ("src", "href", "srcset", "action", "onload", "onclick"), (tag, name, value)
    assert "url(" not in html and "@import" not in html
    assert "svg" in page.tags and "table" in page.tags
    assert "Checklist" in page.text
    # What is measured directly is wrong by the offset of its only sensor.
    said = next(text for text in page.text if text.startswith("winding has no offset: "))
    size, moved, band = map(
        float, re.findall(r"± ([\d.]+) °C from .* temperature by ([\d.]+) °C \(band ± ([\d.]+)\)", said)[0]
    )
    assert moved == pytest.approx(size, rel=0.02) and size > band


def test_html_escapes_what_users_name():
    part = Topic(
        'a <b> & "c"', ("<script>alert(1)</script>",), ("<i>", ""), (("<u>", "yes"),), (Bar("<s>", "°C", 1.0, np.nan),)
    )
    page = ParsedHtml(to_html("<title>", [Topic("head", ()), part]))
    assert not page.tags & {"script", "b", "i", "u", "s"}
    assert "<script>alert(1)</script>" in page.text and "<u>" in page.text and "no number" in page.text


def test_a_mark_says_whether_the_answer_is_good_news():
    """Asked for peaks and heavy tails, a twin does well to say no."""
    rows = (("all well?", "yes"), ("anything wrong?", "no"))
    page = ParsedHtml(to_html("t", [Topic("head", ()), Topic("b", (), ("q", "a"), rows, marks=("good", "good"))]))
    marks = [value for tag, name, value in page.attributes if (tag, name) == ("td", "class")]
    assert marks == ["short", "good short", "short", "good short"]


def test_answers_are_marked_by_what_they_mean(checked):
    found, html = checked
    answers = found["checklist"]
    assert (answers["posterior"]["answer"], answers["linearity"]["answer"]) == ("no", "yes")
    assert '<td class="good short">no</td>' in html and 'class="bad' not in html
    # A bare number has no exponent that a reader must count with.
    assert re.search(r"\de\+0\d", html) is None


@pytest.mark.parametrize(
    "low, high, text",
    [(-2.51, 2.51, "± 2.51 °C"), (-51.6, 137.2, "-51.6 to +137 °C"), (-0.0, 2283.0, "0 to +2,280 °C"),
     (0.0, 0.0, "0 to 0 °C"), (-1.8e10, 1.8e10, "± 1.8e+10 °C"), (-1.0, np.inf, "any size")],
)  # fmt: skip
def test_ranges_in_words(low, high, text):
    assert Nudge("sensor", "winding", "°C", 1.0, -np.inf, np.inf, 1.0).range_text(low, high) == text


def test_text_is_the_same_page(nisus):
    out = nisus("check", "motor_winding", "--duration", "20", "--set", "valid_range={temperature: [293, null]}").out
    assert "valid_range.temperature leaves out the prior's mean, 35 °C: is it in that unit?" in out
    assert "Checklist" in out and "integrity bound" in out and "There is one sensor" in out
    assert max(map(len, out.splitlines())) <= 160


@pytest.mark.parametrize("name, seconds", [("agv_corridor", 10), ("gripper_contact", 1), ("thermal_field", 11)])
def test_what_does_not_apply_is_said_and_nothing_fails(name, seconds, nisus):
    # Numbers that are none are null: JSON has no NaN.
    found = nisus("check", name, "--duration", seconds, "--json").json
    assert set(found) == REQUIRED | MORE
    assert found["smallest_visible"] == []
    assert name == "gripper_contact" or found["integrity"]["reason"] == found["observability"]["reason"] != ""
    if name == "thermal_field":
        assert found["checklist"]["linearity"]["answer"] == "not told"
        assert "temperature, all cells" in found["open_loop"]["states"]
    if name == "agv_corridor":
        # Its building looks the same after half a turn, so that a filter of one peak is lost in it.
        assert "pf is a Monte Carlo filter, and ekf, which would be nudged" in found["integrity"]["reason"]
    if name == "gripper_contact":
        assert found["integrity"]["reason"].startswith("gripper_contact jumps between modes")
