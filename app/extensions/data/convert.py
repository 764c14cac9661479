"""Conversion of recordings: the files of their sources become the files that the twins read.

Each function reads the files of the source in `parts`, under the names `to` of sets.yaml, and writes `makes` beside
them. They are known by their SHA-256, so their content is not checked again.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from estimators.errors import SourceError

from .sets import RecordingSet

UTC_S = 1533180079.646
"""UTC of the RAV4's boot, s since 1970, by the clock of its u-blox receiver."""

GRIB_MESSAGE = np.dtype("S96, >u2, >u4, u1, (33, 49)>u2, S23")
"""Message of GRIB 1 (WMO Manual on Codes, FM 92-IX): sections of 8, 52 and 32 bytes; length, flags, E, R, bits, x."""

MOTOR_HEADERS = {
    "inputs.h": ("u_q", "coolant", "u_d", "motor_speed", "i_d", "i_q", "ambient", "torque", "i_s", "u_s"),
    "targets.h": ("pm", "stator_yoke", "stator_tooth", "stator_winding"),
}
"""Columns of the arrays."""

MOTOR_SESSION, MOTOR_ROWS = 60, 3600


def comma2k19(recording: RecordingSet) -> None:
    """Write the arrays of comma2k19 as BLF and CSV, in UTC.

    Frames that the logger sent (buses 128 and 129) are left out. NumPy has stripped trailing zeros of the data, which
    are padded to the length in the DBC, or to 8 bytes.
    """
    import can
    import cantools

    parts = recording.parts
    t, address, bus, data = (np.load(parts / "raw_can" / name).tolist() for name in ("t", "address", "src", "data"))
    database: Any = cantools.database.load_file(parts / "dbc" / "toyota_2017.dbc", strict=False)
    lengths = {message.frame_id: message.length for message in database.messages}
    with can.BLFWriter(parts / recording.makes[0]) as writer:
        for at, number, channel, content in zip(t, address, bus, data, strict=True):
            if channel < 128:
                full = content.ljust(lengths.get(number, 8), b"\0")
                writer(can.Message(at + UTC_S, number, False, channel=channel, data=full))

    def fixes(receiver: str) -> np.ndarray:
        at, value = (np.load(parts / receiver / name) for name in ("t", "value"))
        return np.column_stack([np.round(at + UTC_S, 6), value[:, [0, 1, 4, 2, 5, 3]]])

    _write(recording, fixes)


def labyrinth(recording: RecordingSet) -> None:
    """Write the lines of the three kinds of libRSF as CSVs."""
    lines = [line.split() for file in recording.files for line in (recording.parts / file.to).read_text().splitlines()]
    _write(recording, lambda kind: np.array([line[1:] for line in lines if line[0] == kind], float))


def plaza(recording: RecordingSet) -> None:
    """Write the matrices of the MAT file as CSVs."""
    from scipy.io import loadmat

    _write(recording, loadmat(recording.parts / "Plaza1_.mat").__getitem__)


def era5(recording: RecordingSet) -> None:
    """Write the first 14 days of the hourly GRIB as a NumPy archive: t2m_K (336, 33, 49), K.

    A message has R + 2^E x with x of 16 bits, and R as sign, exponent of 16 and mantissa. The archive is in steps of
    0.001 K from 280 K, in single precision, as that to which the twin was tuned.
    """
    messages = np.fromfile(recording.parts / "era5-2mt-2019-03-uk.grib", GRIB_MESSAGE, 336)
    e, r = (messages[name].astype(int)[:, None, None] for name in ("f1", "f2"))
    base = (r & 0xFFFFFF) * 2.0**-24 * 16.0 ** ((r >> 24 & 0x7F) - 64)
    kelvin = (base + messages["f4"] * 2.0 ** np.where(e & 0x8000, -(e & 0x7FFF), e)).astype(np.float32)
    step, origin = np.float32(0.001), np.float32(280.0)
    np.savez_compressed(
        recording.parts / recording.makes[0],
        t2m_K=np.round(np.rint((kelvin - origin) / step) * step + origin, 3),
        time=np.datetime64("2019-03-01T00", "ns") + np.arange(336) * np.timedelta64(1, "h"),
        lat_deg=np.linspace(58.0, 50.0, 33),
        lon_deg=np.linspace(-10.0, 2.0, 49),
    )


def motor_headers(recording: RecordingSet) -> None:
    """Write the arrays of two C headers as a CSV. Coolant and ambient are hundredths of 1 °C there."""
    columns: dict[str, np.ndarray] = {}
    for name, order in MOTOR_HEADERS.items():
        array = (recording.parts / name).read_text().partition("] = {")[2].partition(";")[0]
        values = np.array(re.findall(r"[-+.\de]+(?=f)", array), float).reshape(-1, len(order))
        columns |= dict(zip(order, values.T, strict=True))
    _motor(recording, columns | {name: np.round(100.0 * columns[name], 4) for name in ("coolant", "ambient")})


def motor_table(recording: RecordingSet, path: Path) -> None:
    """Write session 60 of Kaggle's table as a CSV, with each column but temperatures divided by its largest magnitude.

    Raises:
        SourceError: If columns are missing, or the values are others.
    """
    import pyarrow as pa
    import pyarrow.csv

    names = [*recording.means]
    try:
        options = pyarrow.csv.ConvertOptions(include_columns=[*names, "profile_id"])
        with path.open("rb") as content:
            table = pyarrow.csv.read_csv(content, convert_options=options)
        columns = {name: table[name].to_numpy().astype(float) for name in table.column_names}
    except (pa.ArrowException, KeyError, ValueError) as error:
        raise SourceError(f"{path}: is not the table of the motor: {error}; give measures_v2.csv") from None
    rows = columns["profile_id"] == MOTOR_SESSION
    scale = {name: np.abs(columns[name]).max() if k < 6 else 1.0 for k, name in enumerate(names)}
    _motor(recording, {name: columns[name][rows] / scale[name] for name in names})


def _motor(recording: RecordingSet, columns: Mapping[str, np.ndarray]) -> None:
    """Write the CSV of the motor; refuse values that are not those to which the twins were tuned."""
    t = np.arange(min(MOTOR_ROWS, len(columns["u_q"])))
    for name, expected in recording.means.items():
        values = columns[name][: t.size]
        if not np.allclose((values.sum() / MOTOR_ROWS, values @ t / MOTOR_ROWS**2), expected, rtol=0.0, atol=2e-4):
            rule = f"{name} of session 60 has not the mean {expected[0]} in its first half hour"
            raise SourceError(f"{recording.name}: {rule}; give measures_v2.csv, or download it again")
    _write(recording, lambda _: np.column_stack([0.5 * t, *(columns[name][: t.size] for name in recording.means)]))


def _write(recording: RecordingSet, rows: Callable[[str], np.ndarray]) -> None:
    """Write the CSVs of a recording, with the shortest digits that give the same numbers."""
    for name, (origin, head) in recording.csv.items():
        width = head.count(",") + 1
        lines = (",".join(map(repr, row[:width])) for row in rows(origin).tolist())
        (recording.parts / name).write_text("\n".join([head, *lines, ""]))
