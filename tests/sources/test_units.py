"""Units convert by their definitions, in the spellings of DBC files; what does not convert is refused."""

import csv
from pathlib import Path

import pytest

from estimators.errors import SourceError
from sources.units import conversion, declared_conversion, heading_unit
from tests.cases import cases
from tests.support import error_of


def test_spellings_of_plants_buses_and_files_convert_by_the_table_or_are_refused():
    """units.csv has their factors by the definitions of the units; none is one that must be refused."""
    wrong = []
    with (Path(__file__).parent / "units.csv").open(encoding="utf-8") as file:
        for line in csv.DictReader(file):
            try:
                found = conversion(line["given"], line["wanted"], "x")
            except SourceError:
                found = None
            expected = (float(line["factor"]), float(line["offset"])) if line["factor"] else None
            if (found and expected) is None and found == expected:
                continue
            if found is None or expected is None or found != pytest.approx(expected, rel=2e-9, abs=1e-12):
                wrong.append((line, found))
    assert wrong == [] and conversion(None, "m/s", "x") == (1.0, 0.0)


@pytest.mark.parametrize(
    ("given", "reason"),
    [("Nm3/h", "at normal or standard conditions"), ("dBm", "is a logarithm"), ("Grad", "a degree or a gon"),
     ("pm", "is 1e-12 of the model's 'm'")],
)  # fmt: skip
def test_what_is_refused_says_why(given, reason):
    with pytest.raises(SourceError, match=reason):
        conversion(given, "m", "x")
    assert heading_unit(f"Value [{given}]") == given
    assert heading_unit("Value [m/0]") is None


@cases(__file__, "no_conversions.csv")
def test_what_does_not_convert_names_both(given, wanted, expected):
    assert error_of(SourceError, conversion, given, wanted, "speed") == expected


@pytest.mark.parametrize(
    ("given", "wanted", "what"),
    [("rpm", "1/s", "a rotation"), ("1/min", "Hz", "a rotation"), ("1/s", "rad/s", "a freq")],
)
def test_a_rotation_is_no_frequency(given, wanted, what):
    """An angle has no unit, so a table of units takes one for the other, off by 2π."""
    with pytest.raises(SourceError, match=f"x: '{given}' is {what}.* they may differ by 2π; give .* under"):
        conversion(given, wanted, "x")
    assert conversion("rpm", "deg/s", "x")[0] == pytest.approx(6.0) and conversion("kHz", "1/s", "x")[0] == 1000.0


def test_a_declared_unit_of_a_quantity_without_unit_is_refused():
    """It would have no effect; one found in a file is only a remark of its logger, and % has no dimension."""
    with pytest.raises(SourceError, match="x: the model's quantity has no unit, so 'furlong' .* as `scale`"):
        declared_conversion("furlong", None, "", "x")
    with pytest.raises(SourceError, match="so 'furz' under"):
        declared_conversion("furz", "m", " ", "x")
    for declared, found in (("%", None), ("-", "m"), (None, "furlong"), ("", "m")):
        assert declared_conversion(declared, found, "", "x") == (1.0, 0.0)
    assert declared_conversion("km/h", "mph", "m/s", "x")[0] == pytest.approx(1 / 3.6)


@pytest.mark.parametrize(
    ("heading", "unit"),
    [
        ("Temp, °C (LGR S/N: 20123456, SEN S/N: 20123456)", "°C"),  # of an Onset HOBO
        ("RH, % (LGR S/N: 20123456, SEN S/N: 20123456, LBL: In)", "%"),
        ("Flow, gpm", "gpm"),
        ("Level, m [mm]", "mm"),
        ("Host Connected (LGR S/N: 20123456)", None),
        ("Date Time, GMT-05:00", None),
        ("Mean (TT1, TT2)", None),
    ],
)
def test_a_unit_may_follow_a_comma(heading, unit):
    assert heading_unit(heading) == unit
