"""Texts of one table in the dialects of loggers, historians and spreadsheets."""

from typing import NamedTuple

import numpy as np

N = 40
T = np.round(np.arange(N) * 0.5 + 0.25, 2)
TEMP = np.round(59.95 + np.sin(np.arange(N) / 5), 3)
FLOW = np.round(1234.5 + 1000 * np.cos(np.arange(N) / 7), 1)
VALUES = np.stack([T, TEMP, FLOW], axis=1)


class Sample(NamedTuple):
    """A table in some dialect, the names of its columns, the remark about it (empty: none), and how pandas reads it."""

    text: str
    names: tuple[str, ...]
    remark: str
    pandas: dict
    encoding: str = "utf-8"


def number(value, decimal=".", group=""):
    text = f"{value:,}" if group else f"{value}"
    return text.replace(",", "?").replace(".", decimal).replace("?", group)


def body(delimiter=",", decimal=".", group="", before="", after="", quote=""):
    """The rows of the table, each between `before` and `after`."""
    cells = ([f"{quote}{number(value, decimal, group)}{quote}" for value in row] for row in VALUES.tolist())
    return "".join(f"{before}{delimiter.join(row)}{after}\n" for row in cells)


def cells(delimiter=",", decimal="."):
    """The rows with a date, a clock and a word in each."""
    return "".join(
        delimiter.join([f"05.03.2024 08:{k:02d}:00", number(x, decimal), number(y, decimal), "Good"]) + "\n"
        for k, (_, x, y) in enumerate(VALUES.tolist())
    )


NAMES = ("time", "TT101", "FT201")
HEAD = "time,TT101,FT201\n"
SEMI = HEAD.replace(",", ";")
LOGGER = "Logger,XY-2000\nSerial,4711\nStart,2024-03-05 08:00:00\nRate,100\n"
WIDE = "Test bench 7,,\nOperator,Jane Doe,\nRate,100,\n"
SECTIONS = "[Header]\nDevice=Logger\nRate=100\n\n[Data]\n"
SEMI_KEYS = {"sep": ";", "decimal": ","}
WORDS = ("Zeit", "TT101", "FT201", "State")

SAMPLES = {
    "plain": Sample(HEAD + body(), NAMES, "", {}),
    "semicolon_comma": Sample(SEMI + body(";", ","), NAMES, "", SEMI_KEYS),
    "tab": Sample(HEAD.replace(",", "\t") + body("\t"), NAMES, "", {"sep": "\t"}),
    "bar": Sample(HEAD.replace(",", "|") + body("|"), NAMES, "", {"sep": "|"}),
    "sep_line": Sample("sep=;\n" + SEMI + body(";", ","), NAMES, "", {**SEMI_KEYS, "skiprows": 1}),
    "section": Sample("[Data]\n" + HEAD + body(), NAMES, "heading in line 2", {"skiprows": 1}),
    "sections": Sample(SECTIONS + HEAD + body(), NAMES, "heading in line 6", {"skiprows": 5}),
    "channels": Sample(
        "[Channels]\nName,Unit,Scale\nTT101,degC,1\nFT201,kg/h,2\n[Data]\n" + HEAD + body(),
        NAMES,
        "heading in line 6",
        {"skiprows": 5},
    ),
    "comments": Sample(
        "# logger 3, firmware 2\n# rate: 2 Hz\n" + HEAD + body().replace("2.25,", "# pump on, manual\n2.25,", 1),
        NAMES,
        "heading in line 3, lines that begin with # are comments",
        {"comment": "#"},
    ),
    "commented_heading": Sample(
        "# logger 3\n# " + HEAD + body(),
        NAMES,
        "heading in line 2, lines that begin with # are comments",
        {"skiprows": 2, "names": NAMES},
    ),
    "commented_first": Sample(
        "#" + HEAD + body(), NAMES, "lines that begin with # are comments", {"skiprows": 1, "names": NAMES}
    ),
    "preamble": Sample(LOGGER + HEAD + body(), NAMES, "heading in line 5", {"skiprows": 4}),
    "blank_lines": Sample(LOGGER + "\n\n" + HEAD + body(), NAMES, "heading in line 7", {"skiprows": 6}),
    "padded_preamble": Sample(WIDE + HEAD + body(), NAMES, "heading in line 4", {"skiprows": 3}),
    "long_preamble": Sample(
        "".join(f"Parameter {k}: {k * k}\n" for k in range(300)) + HEAD + body(),
        NAMES,
        "heading in line 301",
        {"skiprows": 300},
    ),
    "two_columns": Sample(
        "Logger,XY\nOperator,Jane\nRate,100\ntime,TT101\n" + "".join(f"{t},{x}\n" for t, x, _ in VALUES.tolist()),
        NAMES[:2],
        "heading in line 4",
        {"skiprows": 3},
    ),
    "units": Sample(
        HEAD + "s,degC,kg/h\n" + body(),
        ("time [s]", "TT101 [degC]", "FT201 [kg/h]"),
        "heading in line 1, units in line 2",
        {"skiprows": 2, "names": NAMES},
    ),
    "three_rows": Sample(
        HEAD + "[s],[degC],[-]\nClock,Oil sump,Feed\n" + body(),
        ("time [s]", "TT101 [degC]", "FT201"),
        "heading in line 1, units in line 2",
        {"skiprows": 3, "names": NAMES},
    ),
    "campbell": Sample(
        '"TOA5","CR1000","CR1000","1011","CR1000.Std.22","CPU:a.CR1","19246","Table1"\n"time","TT101","FT201"\n'
        '"s","Deg C","kg/h"\n"","Avg","Smp"\n' + body(),
        ("time [s]", "TT101 [Deg C]", "FT201 [kg/h]"),
        "heading in line 2, units in line 3",
        {"skiprows": 4, "names": NAMES},
    ),
    "ignition": Sample(
        '"#NAMES"\n"time","TT101","FT201"\n"#TYPES"\n"D","F","F"\n"#ROWS","40"\n' + body(quote='"'),
        NAMES,
        "heading in line 2",
        {"skiprows": 5, "names": NAMES},
    ),
    "ignition_bare": Sample(
        "#NAMES\n" + HEAD + "#TYPES\nD,F,F\n#ROWS,40\n" + body(),
        NAMES,
        "heading in line 2",
        {"skiprows": 5, "names": NAMES},
    ),
    "labview": Sample(
        "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t.\nX_Columns\tOne\nDate\t2024/03/15\n"
        "Time\t08:00:00.1234567890123456789\n***End_of_Header***\t\n\t\nChannels\t2\t\t\nSamples\t40\t40\t\n"
        "Date\t2024/03/15\t2024/03/15\t\nY_Unit_Label\tVolts\tDeg C\t\nX0\t0.0000E+0\t0.0000E+0\t\n"
        "Delta_X\t0.500000\t0.500000\t\n***End_of_Header***\t\t\t\nX_Value\tTT101\tFT201\tComment\n" + body("\t"),
        ("X_Value", "TT101", "FT201"),
        "heading in line 16",
        {"sep": "\t", "skiprows": 16, "names": NAMES},
    ),
    "no_heading": Sample(body(), ("c1", "c2", "c3"), "no heading, so columns are named c1 to c3", {"header": None}),
    "trailing": Sample(HEAD + body(after=","), NAMES, "", {"index_col": False}),
    "trailing_all": Sample(HEAD[:-1] + ",\n" + body(after=","), NAMES, "", {"usecols": NAMES}),
    "heading_commas": Sample(
        "time;Mean (TT1, TT2, TT3, TT4);FT201\n" + body(";", ","),
        ("time", "Mean (TT1, TT2, TT3, TT4)", "FT201"),
        "",
        SEMI_KEYS,
    ),
    "heading_tie": Sample(
        "time;Temp, degC;Flow, kg/h\n" + body(";", ","), ("time", "Temp, degC", "Flow, kg/h"), "", SEMI_KEYS
    ),
    "quoted_comma": Sample(HEAD + body(decimal=",", quote='"'), NAMES, "decimal comma", {"decimal": ","}),
    "quoted_semicolon": Sample(SEMI + body(";", ",", quote='"'), NAMES, "", SEMI_KEYS),
    "mixed_quotes": Sample(
        '"time",TT101,"FT201"\n' + body().replace("2.25,", '"2.25",', 1).replace("3.25,", "3.25 ,", 1), NAMES, "", {}
    ),
    "thousands_us": Sample(HEAD + body(group=",", quote='"'), NAMES, "thousands separator ','", {"thousands": ","}),
    "thousands_semicolon": Sample(
        SEMI + body(";", group=","),
        NAMES,
        "thousands separator ','",
        {"sep": ";", "thousands": ","},
    ),
    "thousands_de": Sample(
        SEMI + body(";", ",", "."),
        NAMES,
        "decimal comma, thousands separator '.'",
        {**SEMI_KEYS, "thousands": "."},
    ),
    "thousands_fr": Sample(
        SEMI + body(";", ",", "\u202f"),
        NAMES,
        "decimal comma, thousands separator '\\u202f'",
        {**SEMI_KEYS, "thousands": "\u202f", "engine": "python"},
    ),
    "thousands_space": Sample(
        SEMI + body(";", ",", " "),
        NAMES,
        "decimal comma, thousands separator ' '",
        {**SEMI_KEYS, "thousands": " "},
    ),
    "thousands_ch": Sample(
        SEMI + body(";", group="'"),
        NAMES,
        'thousands separator "\'"',
        {"sep": ";", "thousands": "'"},
    ),
    "utf16": Sample(SEMI + body(";", ","), NAMES, "", SEMI_KEYS, "utf-16"),
    "utf16le": Sample(HEAD + body(), NAMES, "", {}, "utf-16-le"),
    "utf16be": Sample(HEAD.replace(",", "\t") + body("\t"), NAMES, "", {"sep": "\t"}, "utf-16-be"),
    "spaces": Sample(
        "  time   TT101  FT201\n" + body("   ", before="  "),
        NAMES,
        "columns separated by spaces",
        {"sep": r"\s+"},
    ),
    "commented_spaces": Sample(
        "# time TT101 FT201\n" + body(" "),
        NAMES,
        "columns separated by spaces, lines that begin with # are comments",
        {"sep": r"\s+", "skiprows": 1, "names": NAMES},
    ),
    "footer": Sample(HEAD + body() + "\nEnd of file\n", NAMES, "", {"skipfooter": 2, "engine": "python"}),
    "words": Sample("Zeit;TT101;FT201;State\n" + cells(";", ","), WORDS, "", SEMI_KEYS),
    "words_preamble": Sample(
        "Werk Nord, Halle 3\n\nZeit;TT101;FT201;State\n;degC;kg/h;\n" + cells(";", ","),
        ("Zeit", "TT101 [degC]", "FT201 [kg/h]", "State"),
        "heading in line 3, units in line 4, decimal comma",
        {**SEMI_KEYS, "skiprows": 4, "names": WORDS},
    ),
}
"""The values of all but the last two are `VALUES`."""

REPORTED = {
    "a_sep": (
        "sep=;\n"
        "Zeit;TT101 [°C];PT201 [bar]\n"
        "05.03.2024 08:00:00;59,949;2,004\n"
        "05.03.2024 08:01:00;60,159;2,013\n"
        "05.03.2024 08:02:00;59,951;2,038\n"
        "05.03.2024 08:03:00;60,030;2,064\n"
        "05.03.2024 08:04:00;59,929;2,076\n"
        "05.03.2024 08:05:00;59,706;2,105\n",
        {"sep": ";", "decimal": ",", "skiprows": 1},
    ),
    "b_section": (
        "[Data]\n"
        "Tagname,TimeStamp,Value,DataQuality\n"
        "PLANT.TT101.F_CV,03/05/2024 08:00,59.949,Good\n"
        "PLANT.TT101.F_CV,03/05/2024 08:01,60.159,Good\n"
        "PLANT.TT101.F_CV,03/05/2024 08:02,59.951,Good\n"
        "PLANT.TT101.F_CV,03/05/2024 08:03,60.030,Good\n"
        "PLANT.TT101.F_CV,03/05/2024 08:04,59.929,Good\n"
        "PLANT.TT101.F_CV,03/05/2024 08:05,59.706,Good\n",
        {"skiprows": 1},
    ),
    "e_trailing": (
        "time,TT101,PT201\n"
        "2024-03-05 08:00:00,59.949,2.004,\n"
        "2024-03-05 08:01:00,60.159,2.013,\n"
        "2024-03-05 08:02:00,59.951,2.038,\n"
        "2024-03-05 08:03:00,60.030,2.064,\n"
        "2024-03-05 08:04:00,59.929,2.076,\n"
        "2024-03-05 08:05:00,59.706,2.105,\n"
        "2024-03-05 08:06:00,59.795,2.121,\n",
        {"index_col": False},
    ),
    "h_headcommas": (
        "Zeit;Mittel (TT101, TT102, TT103, TT104);PT201\n"
        "05.03.2024 08:00:00;59,949;2,004\n"
        "05.03.2024 08:01:00;60,159;2,013\n"
        "05.03.2024 08:02:00;59,951;2,038\n"
        "05.03.2024 08:03:00;60,030;2,064\n"
        "05.03.2024 08:04:00;59,929;2,076\n"
        "05.03.2024 08:05:00;59,706;2,105\n"
        "05.03.2024 08:06:00;59,795;2,121\n",
        {"sep": ";", "decimal": ","},
    ),
    "m_quotedcomma": (
        "Zeit,TT101,PT201\n"
        '"05.03.2024 08:00:00","59,949","2,004"\n'
        '"05.03.2024 08:01:00","60,159","2,013"\n'
        '"05.03.2024 08:02:00","59,951","2,038"\n'
        '"05.03.2024 08:03:00","60,030","2,064"\n'
        '"05.03.2024 08:04:00","59,929","2,076"\n'
        '"05.03.2024 08:05:00","59,706","2,105"\n'
        '"05.03.2024 08:06:00","59,795","2,121"\n',
        {"decimal": ","},
    ),
}
"""Begin of files that were refused, and how pandas reads them."""
