"""Encodings of DBC files."""

import pytest

from sources.can.database import encoding_of, load_database
from sources.units import conversion

TEXT = """BU_: E
BO_ 256 M: 8 E
 SG_ S : 0|8@1+ (1,0) [0|0] "{unit}" E
CM_ SG_ 256 S "{comment}";
VAL_ 256 S 0 "{comment}" ;
"""


@pytest.mark.parametrize(
    ("encoding", "unit", "comment"),
    [
        ("utf-8", "°C", "Wärme der Größe µ"),
        ("utf-8-sig", "°C", "Kühlmittel"),
        ("cp1252", "°C", "Kühlmittel, Größe öß"),
        ("cp1252", "°C", "température réglée"),
        ("cp1252", "µA", "plain"),
        ("gb2312", "℃", "电机温度"),
        ("gbk", "℃", "发动机转速，镕"),  # the last one is in GBK alone
        ("gb18030", "r/min", "电压"),
        ("ascii", "rpm", "plain"),
    ],
)
def test_text_of_a_dbc_has_its_encoding(tmp_path, encoding, unit, comment):
    path = tmp_path / "a.dbc"
    path.write_bytes(TEXT.format(unit=unit, comment=comment).encode(encoding))
    (signal,) = load_database(path).messages[0].signals
    assert (signal.unit, signal.comment, str(signal.conversion.choices[0])) == (unit, comment, comment)


def test_a_degree_of_gb2312_converts():
    assert conversion("℃", "K", "temp") == conversion("degC", "K", "temp")


@pytest.mark.parametrize("text", ["Größe", "Straße öß", "°C ±5 µm", "ÄÖÜäöü"])
def test_western_text_is_not_taken_for_chinese(text):
    assert encoding_of(text.encode("cp1252")) == "cp1252"
