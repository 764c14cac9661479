"""Workbooks, written as the XML of their format: values, dates, headings and sheets."""

import zipfile
from xml.sax.saxutils import escape

import numpy as np
import pytest

from app.cli.main import main
from estimators.errors import SourceError
from estimators.log import READING
from sources import formats
from sources.inspect import inspect_recordings
from sources.source import Channel
from sources.tables.dialect import Dialect
from sources.tables.rows import names_of
from sources.tables.table import Table
from sources.tables.times import TimeColumn
from tests.app.twin.written import twin_of
from tests.sources.can.can_tools import Reports
from tests.support import error_of, read_all

pytest.importorskip("python_calamine", reason="needs nisus[excel]")

SHEETS = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
OFFICE = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
PACKAGE = "http://schemas.openxmlformats.org/package/2006"
FIRST_DAY = 45356  # 2024-03-05, which is day 19,787 since 1970 (date -u +%s)
DAY_NS = 86_400 * 10**9


class Date(float):
    """A serial date, which is formatted as one."""


def cell(value):
    if isinstance(value, str):
        return f'<c t="inlineStr"><is><t>{escape(value)}</t></is></c>'
    return f'<c s="1"><v>{float(value)!r}</v></c>' if isinstance(value, Date) else f"<c><v>{value!r}</v></c>"


def write(path, **sheets):
    """A workbook of sheets, each a list of rows; an empty text is an absent cell."""
    kinds = "".join(
        f'<Override PartName="/xl/worksheets/sheet{k}.xml" '
        'ContentType="application/vnd.openxmlformats-officedocument.spreadsheetml.worksheet+xml"/>'
        for k in range(len(sheets))
    )
    parts = {
        "[Content_Types].xml": f'<Types xmlns="{PACKAGE}/content-types"><Default Extension="rels" '
        'ContentType="application/vnd.openxmlformats-package.relationships+xml"/><Override PartName="/xl/workbook.xml" '
        'ContentType="application/vnd.openxmlformats-officedocument.spreadsheetml.sheet.main+xml"/>'
        f"{kinds}</Types>",
        "_rels/.rels": f'<Relationships xmlns="{PACKAGE}/relationships"><Relationship Id="r" '
        f'Type="{OFFICE}/officeDocument" Target="xl/workbook.xml"/></Relationships>',
        "xl/workbook.xml": f'<workbook xmlns="{SHEETS}" xmlns:r="{OFFICE}"><sheets>'
        + "".join(f'<sheet name="{name}" sheetId="{k + 1}" r:id="r{k}"/>' for k, name in enumerate(sheets))
        + "</sheets></workbook>",
        "xl/_rels/workbook.xml.rels": f'<Relationships xmlns="{PACKAGE}/relationships">'
        f'<Relationship Id="s" Type="{OFFICE}/styles" Target="styles.xml"/>'
        + "".join(
            f'<Relationship Id="r{k}" Type="{OFFICE}/worksheet" Target="worksheets/sheet{k}.xml"/>'
            for k in range(len(sheets))
        )
        + "</Relationships>",
        "xl/styles.xml": f'<styleSheet xmlns="{SHEETS}"><cellXfs count="2"><xf numFmtId="0"/><xf numFmtId="22"/>'
        "</cellXfs></styleSheet>",
    }
    for k, rows in enumerate(sheets.values()):
        lines = "".join(
            f'<row r="{n}">'
            + "".join(cell(one).replace("<c", f'<c r="{chr(65 + j)}{n}"', 1) for j, one in enumerate(row) if one != "")
            + "</row>"
            for n, row in enumerate(rows, start=1)
        )
        parts[f"xl/worksheets/sheet{k}.xml"] = f'<worksheet xmlns="{SHEETS}"><sheetData>{lines}</sheetData></worksheet>'
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in parts.items():
            archive.writestr(name, f'<?xml version="1.0" encoding="UTF-8"?>{text}')
    return path


TEMP = np.round(60 + np.sin(np.arange(50) / 5), 3).tolist()
ROWS = [[Date(FIRST_DAY + k / 1440), x, k * 1000] for k, x in enumerate(TEMP)]
NAMES = ["Time", "TT101", "FT201"]


def read(path, *columns, time="Time", dialect=Dialect(), report=None):  # noqa: B008
    channels = [Channel(READING, k, name, (name,)) for k, name in enumerate(columns)]
    column = time if isinstance(time, TimeColumn) else TimeColumn(time)
    return read_all(Table([path], time=column, channels=channels, width=1, report=report or Reports(), dialect=dialect))


def test_numbers_and_dates_are_those_of_the_cells(tmp_path):
    path, reports = write(tmp_path / "a.xlsx", Data=[NAMES, *ROWS]), Reports()
    assert formats.is_recording("a.xlsx") and names_of(path) == NAMES
    events = read(path, "TT101", "FT201", report=reports)
    assert events.value[events.channel == 0, 0].tolist() == TEMP
    assert events.value[events.channel == 1, 0].tolist() == [k * 1000.0 for k in range(50)]
    minutes = [19_787 * DAY_NS + k * 60 * 10**9 for k in range(50)]
    np.testing.assert_allclose(events.t[events.channel == 0], minutes, rtol=0, atol=10**6)  # a serial date has 1 ms
    assert not reports.counts


def test_heading_units_blanks_and_words_are_as_in_a_csv(tmp_path):
    rows = [["Bench 7"], [], NAMES, ["", "degC", "kg/h"], *ROWS]
    rows[6] = [ROWS[2][0], "", "Bad"]
    path, reports = write(tmp_path / "a.xlsx", Data=rows), Reports()
    assert names_of(path) == ["Time", "TT101 [degC]", "FT201 [kg/h]"]
    events = read(path, "TT101 [degC]", "FT201 [kg/h]", report=reports)
    assert events.value[events.channel == 0, 0].tolist() == [x for k, x in enumerate(TEMP) if k != 2]
    np.testing.assert_array_equal(
        events.value[events.channel == 1, 0], [np.nan if k == 2 else k * 1e3 for k in range(50)]
    )
    assert reports.texts["format of a table"] == "a.xlsx:4: heading in line 3, units in line 4"
    assert reports.texts["no value FT201 [kg/h]: Bad"].startswith("a.xlsx:7: ")
    found = inspect_recordings([path])
    assert [one.unit for one in found.columns] == ["degC", "kg/h"] and found.time.name == "Time"


def test_the_first_sheet_with_a_table_is_read_and_others_are_named(tmp_path):
    notes = [["Notes"], ["recorded by Jane"]]
    other = [NAMES, *[[t, x + 1, y] for t, x, y in ROWS]]
    path, reports = write(tmp_path / "a.xlsx", Notes=notes, Data=[NAMES, *ROWS], Raw=other), Reports()
    assert read(path, "TT101", report=reports).value[:, 0].tolist() == TEMP
    remark = "sheet 'Data' is read, of those with a table: Data, Raw (sheet, --sheet)"
    assert reports.texts["format of a table"] == f"a.xlsx:1: {remark}"
    assert remark in inspect_recordings([path]).faults[0]
    raw = read(path, "TT101", dialect=Dialect(sheet="Raw")).value[:, 0].tolist()
    assert raw == [x + 1 for x in TEMP]
    text = error_of(SourceError, names_of, path, "", Dialect(sheet="Rav"))
    assert text == f"{path}: there is no sheet 'Rav'; did you mean Raw?"
    text = error_of(SourceError, names_of, write(tmp_path / "b.xlsx", Notes=notes))
    rule = "no rows of numbers below a heading; give --heading, or another --sheet"
    assert text == f"{tmp_path}/b.xlsx: sheets Notes have {rule}"


def test_date_and_clock_may_be_two_columns_and_words_are_counted(tmp_path):
    rows = [["Date", "Clock", "TT101", "State"]]
    rows += [["05.03.2024", f"08:{k:02d}:00", x, "Good" if k % 2 else "Bad"] for k, x in enumerate(TEMP)]
    path = write(tmp_path / "a.xlsx", Data=rows)
    found = inspect_recordings([path], time=TimeColumn("", zone="UTC", format="%d.%m.%Y %H:%M:%S"))
    assert found.time.names == ("Date", "Clock") and np.diff(found.t).tolist() == [60 * 10**9] * 49
    assert found.texts["State"] == {"Good": 25, "Bad": 25}


def test_a_twin_and_the_command_line_name_the_sheet(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "a.xlsx", Data=[NAMES, *ROWS], Raw=[NAMES, *ROWS[:20]])
    twin = twin_of(
        "model: motor_winding\nsource: {type: table, files: a.xlsx, sheet: Raw, time: {column: Time}, "
        "sensors: {winding: {columns: TT101}}}\n"
    )
    assert read_all(twin.open_source(Reports(), live=False)).t.size == 20
    assert main(["log", "a.xlsx", "--sheet", "Raw"]) == 0
    assert "a.xlsx: 20 rows" in capsys.readouterr().out


def test_a_damaged_workbook_and_a_missing_extension_are_one_line(tmp_path, monkeypatch):
    path = write(tmp_path / "a.xlsx", Data=[NAMES, *ROWS])
    path.write_bytes(path.read_bytes()[:1500])
    assert error_of(SourceError, names_of, path).startswith(f"{path}: it cannot be read as a workbook (")
    monkeypatch.setattr(formats, "added", lambda kind: {})
    text = error_of(SourceError, names_of, path)
    assert text == f"{path}: needs the extension excel, which is not there: pip install 'nisus[excel]'"
