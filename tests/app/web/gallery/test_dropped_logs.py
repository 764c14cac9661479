"""A dropped log is read as `nisus log` reads it, with its options as fields, and refused in the same words."""

import ast
import re
from dataclasses import fields
from datetime import UTC, datetime

import pytest
import yaml

from app.cli.arguments import TableOptions
from app.cli.main import main
from app.study.advice.plan import YAML_NAME
from app.web.gallery.dropped_logs import FIELD, DraftRequest, DroppedLogs, LogRequest
from app.web.gallery.recordings import Recordings
from estimators.errors import NisusError
from sources.tables.times import SERIAL_DAYS, UNITS
from tests import ROOT
from tests.support import error_of
from tests.waiting import wait_for

READERS = (
    "sources", "app/study/log_overview.py", "app/study/advice", "app/twin/log_match.py",
    *(f"app/extensions/{name}" for name in ("excel", "mf4", "robotics", "tdms")),
)  # fmt: skip
"""Files and folders whose messages a dropped log may cause."""

NOT_SHOWN = "nisus filters --twin", "--out {}"  # In a draft's YAML, and of a bag that is written

PAGE = (ROOT / "app/web/page/dropped_log.js").read_text()


@pytest.fixture
def logs(tmp_path):
    """The dropped logs of a folder, without a twin; a drafted one goes to `started`."""
    logs = DroppedLogs(Recordings(tmp_path), list, started.append)
    started.clear()
    return logs


started: list[str] = []


def read(logs, tmp_path, text, name="log.csv", **how):
    """Write a log, and return what the page shows of it once it has been read."""
    (tmp_path / name).write_text(text)
    wanted = LogRequest(name, **how)
    wait_for(lambda: logs.read(wanted)[1].over)
    return logs.state(wanted)


def texts(path):
    """Yield every text of a Python file that is no docstring, with its line; a value within is {}."""
    tree = ast.parse(path.read_text())
    apart = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    apart |= {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant | ast.JoinedStr) and id(node) not in apart:
            yield "".join(map(word, getattr(node, "values", [node]))), node.lineno


def word(part):
    """Return a part of a text."""
    if isinstance(part, ast.Constant):
        return str(part.value)
    return YAML_NAME if ast.unparse(part.value) == "YAML_NAME" else "{}"


def messages():
    """Every message of the readers that names an option; a name follows one that is a text by itself."""
    for reader in READERS:
        for path in [ROOT / reader] if reader.endswith(".py") else sorted((ROOT / reader).rglob("*.py")):
            for text, line in texts(path):
                if re.search(r"--[a-z]", text) and not any(other in text for other in NOT_SHOWN):
                    yield pytest.param(f"{text} ", id=f"{path.stem}:{line}")


@pytest.mark.parametrize("message", list(messages()))
def test_no_option_of_the_command_line_is_on_the_page(logs, message):
    words = logs._words(message)
    assert not re.search(r"--[a-z]|nisus (advise|tune)| with *$", words), words


def test_the_page_has_a_field_for_each_option_and_each_unit():
    """Options of `nisus log`, keys of a request, labels of fields and the words for them are in step."""
    options = {item.name.removeprefix("time_") for item in fields(TableOptions)}
    assert options <= {item.name for item in fields(LogRequest)}
    _, *named = re.search(r"FIELDS = \{(.*?)\n\};", PAGE, re.DOTALL)[0].split("{", 1)
    labels = re.findall(r'(\w+): "', named[0])
    assert {label.lower() for label in labels} == options - {"dbc", "time", "unit"}
    words = set(re.search(r"\(([^()]*)\)$", FIELD.pattern)[1].split("|"))
    assert words == {label.lower() for label in labels} | {"unit"}
    units = re.findall(r'(\w+): "', re.search(r"UNITS = \{(.*)\};", PAGE)[1])
    assert units == [*UNITS, *SERIAL_DAYS]


US_DATES = "time,v\n" + "".join(f"03/05/2024 08:0{k}:00,{k}\n" for k in range(3))
DOUBT = "t,a\n" + "".join(f'{k},"1,{234 + k}"\n' for k in range(30))


def test_dates_that_may_be_either_are_asked_for_and_read_in_the_given_format(logs, tmp_path):
    found = read(logs, tmp_path, US_DATES)
    assert found["needs"] == "time" and found["faults"] == [
        "time is '03/05/2024 08:00:00', which may be day/month or month/day; set the time's format (Format): "
        '"%d/%m/%Y %H:%M:%S" or "%m/%d/%Y %H:%M:%S"'
    ]
    for form, month, day in (("%m/%d/%Y %H:%M:%S", 3, 5), ("%d/%m/%Y %H:%M:%S", 5, 3)):
        found = read(logs, tmp_path, US_DATES, format=form)
        assert (found["needs"], found["time"]) == (None, "time")
        assert found["start"] == datetime(2024, month, day, 8, tzinfo=UTC).timestamp()
    # Eight o'clock in New York, in daylight saving time, is noon.
    found = read(logs, tmp_path, US_DATES, format="%d/%m/%Y %H:%M:%S", zone="America/New_York")
    assert found["start"] == datetime(2024, 5, 3, 12, tzinfo=UTC).timestamp()


def test_a_comma_that_may_be_either_is_read_as_given(logs, tmp_path):
    found = read(logs, tmp_path, DOUBT)
    assert found["state"] == "failed"
    assert found["error"] == "log.csv:2: '1,234' may be 1234 or 1.234; give Decimal . or Decimal ,"
    for sign, low in ((",", 1.234), (".", 1234.0)):
        (signal,) = read(logs, tmp_path, DOUBT, decimal=sign)["signals"]
        assert (signal["name"], signal["low"]) == ("a", low)


@pytest.mark.parametrize(
    ("text", "how", "names"),
    [
        ("a|b\n0|1\n1|2\n", {"delimiter": "|", "time": "a"}, ["b"]),
        ("0,1\n1,2\n", {"heading": "none", "time": "c1"}, ["c2"]),
        ("x,y\nt,level\n0,1\n1,2\n", {"heading": "2"}, ["level"]),
        ("x,1\ny,2\nt,level\n0,1\n1,2\n", {"skip": 2}, ["level"]),
        ("a,level\n0,1\n1,2\n", {"time": "a", "unit": "d"}, ["level"]),
    ],
    ids=lambda part: "-".join(part) if isinstance(part, dict) else "",
)
def test_a_table_is_read_as_it_is_written(logs, tmp_path, text, how, names):
    found = read(logs, tmp_path, text, **how)
    assert [signal["name"] for signal in found["signals"]] == names
    assert found["seconds"] == UNITS[how.get("unit", "s")] * 1e-9


@pytest.mark.parametrize(
    "how",
    [{"unit": "parsec"}, {"zone": "Mars"}, {"heading": "x"}, {"delimiter": "::"}, {"decimal": ";"}, {"skip": -1}],
    ids=str,
)
def test_a_wrong_value_is_refused_as_in_the_terminal(logs, tmp_path, capsys, how):
    path = tmp_path / "log.csv"
    path.write_text("t,a\n0,1\n1,2\n")
    ((key, value),) = how.items()
    option = f"--time-{key}" if key in ("unit", "zone") else f"--{key}"
    assert main(["log", str(path), option, str(value)]) != 0
    refused = error_of(NisusError, logs.state, LogRequest("log.csv", **how))
    assert refused.startswith(key) and f"nisus: {option}{refused.removeprefix(key)}\n" == capsys.readouterr().err


def test_the_facts_are_those_of_the_terminal(logs, tmp_path, capsys):
    """Gaps of all and of one, rows that repeat, the zone, words in a column, and what is assumed."""
    rows = [
        f"2024-03-05 08:{k // 60:02}:{k % 60:02},{k // 5 * 37 % 101},{'' if 100 < k < 180 else k * k % 53 + 0.25},"
        f"{'Bad' if k == 7 else 'Good'}\n"
        for k in range(400)
        if not 200 < k < 290
    ]
    found = read(logs, tmp_path, "time,held,level,quality\n" + "".join(rows), zone="Europe/Berlin")
    assert main(["log", str(tmp_path / "log.csv"), "--time-zone", "Europe/Berlin"]) == 0
    title, *lines = map(str.strip, capsys.readouterr().out.splitlines())
    assert found["facts"] == lines[: len(found["facts"])] and title.startswith("log.csv: 311 rows in 399.0 s, from")
    assert "1 gaps: 90.0 s at 200.0 s" in found["facts"]
    assert "level: 1 gap, the longest 80.0 s at 100.0 s" in found["facts"]
    assert "time: column time, local time of Europe/Berlin" in found["facts"]
    assert "quality: text: Good (310), Bad (1)" in found["facts"]
    assert any(line.startswith("held: ") for line in found["facts"])


def test_why_no_roles_can_be_proposed_is_said(logs, tmp_path):
    found = read(logs, tmp_path, "t,a\n" + "".join(f"{k},1\n" for k in range(30)))
    assert (found["state"], found["roles"]) == ("ready", None)
    assert found["unproposed"] == "log.csv: no signal varies; name those to take"


def test_a_text_is_a_log_by_what_it_holds(logs, tmp_path):
    recordings = Recordings(tmp_path)
    frames = "".join(f" ({1.6e9 + k:.6f})  can0  123   [2]  0{k} 00\n" for k in range(5))
    for name, text, kind in (("dump.txt", frames, "can_log"), ("table.txt", "t,a\n0,1\n1,2\n", "table")):
        assert recordings.receive(name, 0, text.encode(), last=True) == name
        assert read(logs, tmp_path, text, name)["kind"] == kind
    assert {entry["name"]: entry["log"] for entry in recordings.entries()} == {"dump.txt": True, "table.txt": True}


def test_a_draft_reads_the_log_as_the_page_did(logs, tmp_path):
    rows = "".join(f'03/05/2024 08:00:{k:02},"1,{234 + 97 * k * k % 701}"\n' for k in range(60))
    how = {"format": "%m/%d/%Y %H:%M:%S", "decimal": ",", "zone": "Europe/Berlin"}
    read(logs, tmp_path, "time,level\n" + rows, **how)
    logs.draft(DraftRequest("log.csv", **how, twin="tank", roles={"states": (0,)}))
    wait_for(lambda: logs.drafting()["state"] != "running")
    assert logs.drafting()["error"] is None and started == [str(tmp_path / "tank.yaml")]
    source = yaml.safe_load((tmp_path / "tank.yaml").read_text())["source"]
    assert source["time"] == {"column": "time", "unit": "s", "format": how["format"], "zone": "Europe/Berlin"}
    assert source["decimal"] == ","
