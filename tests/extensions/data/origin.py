"""A local server that has the files of a source, and these files made from the copy of a recording."""

import hashlib
import io
import struct
import threading
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import can
import numpy as np
from scipy.io import savemat

from app.extensions.data import command, gallery, sets
from app.extensions.data.sets import MIRROR, SourceFile
from tests.waiting import LIMIT_S


class Origin:
    """Files of the server, its failures, and the requests that it had: (path, Range)."""

    def __init__(self):
        self.files, self.asked = {}, []
        self.cuts = []
        """Bytes after which the next answers end too early."""
        self.status = None
        self.ranges = True
        self.wait = None
        """Event that is awaited in the middle of each answer."""

    def answer(self, handler):
        path, wanted = urlsplit(handler.path).path, handler.headers["Range"] or "bytes=0-"
        self.asked.append((path, wanted))
        content = self.files.get(path)
        if self.status or content is None:
            return handler.send_error(self.status or 404)
        begin = int(wanted.removeprefix("bytes=").removesuffix("-")) if self.ranges else 0
        handler.send_response(206 if begin else 200)
        handler.send_header("Content-Length", str(len(content) - begin))
        handler.end_headers()
        rest = content[begin:]
        if self.cuts:
            return handler.wfile.write(rest[: self.cuts.pop(0)])
        if self.wait is not None:
            handler.wfile.write(rest[: len(rest) // 2])
            self.wait.wait(LIMIT_S)
            rest = rest[len(rest) // 2 :]
        return handler.wfile.write(rest)


@contextmanager
def serving():
    """An `Origin` and its address."""
    origin = Origin()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            origin.answer(self)

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    try:
        yield origin, f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


def offer(monkeypatch, folder, origin, address, name, contents):
    """Have a recording come from a local server with other contents of its files; return it, anew at each call."""
    monkeypatch.setenv("NISUS_DATA", str(folder))
    monkeypatch.setenv(MIRROR, address)
    true = sets.recordings

    def table():
        whole = true()
        files = []
        for file in whole[name].files:
            content = contents[file.to]
            origin.files[urlsplit(file.url).path] = content
            files.append(SourceFile(file.url, file.to, len(content), hashlib.sha256(content).hexdigest()))
        return {**whole, name: replace(whole[name], files=files)}

    for module in (sets, command, gallery):
        monkeypatch.setattr(module, "recordings", table)
    table()
    return lambda: table()[name]


LABYRINTH = {
    "Indoor_UWB_Input.txt": b"range2 0.5 2.25 0.01 -0.02 -0.01 105 0 \nodom2diff 0.5 0.125 0.25 0 0.0785 1 1 1\n" * 500,
    "Indoor_UWB_GT.txt": b"point2 0.5 1.65 2.21 0 0 0 0 \n" * 100,
}
"""Files of the form of agv_uwb_labyrinth."""


def contents(name, copy):
    """The files of a source, by name, from the copy of the recording that was made of them."""
    return {
        "agv_plaza_uwb": plaza,
        "can_comma2k19_rav4": comma2k19,
        "field_era5_uk_t2m": era5,
        "motor_pmsm_paderborn": motor,
    }.get(name, unchanged)(name, copy)


def unchanged(name, copy):
    return {file.to: (copy / file.to).read_bytes() for file in sets.recordings()[name].files}


def table(path):
    return np.genfromtxt(path, delimiter=",", skip_header=1)


def plaza(_, copy):
    file = io.BytesIO()
    parts = {"DR": "odometry", "TD": "ranges", "GT": "truth"}
    savemat(file, {key: table(copy / f"plaza1_{part}.csv") for key, part in parts.items()})
    return {"Plaza1_.mat": file.getvalue()}


def saved(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


BOOT_S = 1533180079.646


def comma2k19(_, copy):
    frames = [*can.BLFReader(copy / "rav4_2018-08-02_seg40.blf")]
    sent = [can.Message(frames[-1].timestamp, 0x201, channel=bus, data=b"\1\2") for bus in (128, 129)]
    frames = [*frames[:5], *sent, *frames[5:]]
    found = {
        "raw_can/t": saved(np.array([frame.timestamp - BOOT_S for frame in frames])),
        "raw_can/address": saved(np.array([frame.arbitration_id for frame in frames])),
        "raw_can/src": saved(np.array([frame.channel for frame in frames])),
        "raw_can/data": saved(np.array([bytes(frame.data) for frame in frames], "S8")),
        "dbc/toyota_2017.dbc": (copy / "dbc" / "toyota_2017.dbc").read_bytes(),
    }
    for receiver in ("gnss_ublox", "gnss_qcom"):
        at, latitude, longitude, altitude, speed, bearing, utc = table(copy / f"{receiver}.csv").T
        found[f"{receiver}/t"] = saved(at - BOOT_S)
        found[f"{receiver}/value"] = saved(np.column_stack([latitude, longitude, speed, utc, altitude, bearing]))
    return found


def era5(_, copy):
    """GRIB 1 with one message an hour, in steps of 2^-11 K from a multiple of 1 K, and an hour more than is read."""
    kelvin = np.load(copy / "era5_t2m_uk_2019-03_days01-14.npz")["t2m_K"].astype(float)
    messages = []
    for field in (*kelvin, kelvin[0]):
        base = int(field.min())
        reference = 0x40000000 | (0x03 << 24) | (base << 12)  # 16^3 · base · 2^-12
        x = np.rint((field - base) * 2**11).astype(">u2").tobytes()
        data = struct.pack(">3sBHIB", (11 + len(x)).to_bytes(3, "big"), 8, 0x8000 | 11, reference, 16) + x
        whole = b"GRIB\0\0\0\1" + b"\0\0\x34".ljust(52, b"\0") + b"\0\0\x20".ljust(32, b"\0") + data + b"7777"
        messages.append(whole.ljust(3360, b"\0"))
    return {"era5-2mt-2019-03-uk.grib": b"".join(messages)}


def header(columns, scale):
    rows = zip(*(column * scale.get(k, 1.0) for k, column in enumerate(columns)))
    text = ",\n".join("    {\n" + ",\n".join(f"        {value:.9g}f" for value in row) + "\n    }" for row in rows)
    whole = f"#define LAST 0.5f\nstatic const float a[N][M] = {{\n{text}\n}};\nstatic const float b[1] = {{7.5f}};\n"
    return whole.encode()


def motor(_, copy):
    t, u_q, u_d, speed, i_d, i_q, torque, coolant, ambient, winding, tooth, yoke, pm = table(next(copy.glob("*.csv"))).T
    inputs = [u_q, coolant, u_d, speed, i_d, i_q, ambient, torque, 0 * t, 0 * t]
    return {"inputs.h": header(inputs, {1: 0.01, 6: 0.01}), "targets.h": header([pm, yoke, tooth, winding], {})}


def kaggle(copy):
    """Kaggle's table: volts, amperes and rpm, other sessions, one of which has the largest magnitudes."""
    columns = table(next(copy.glob("*.csv"))).T[1:]
    scale = np.array([[133.0], [131.5], [6000.0], [278.0], [301.0], [261.0]])
    session = np.vstack([columns[:6] * scale, columns[6:], np.full((1, columns.shape[1]), 60)])
    other = np.vstack([-scale, np.full((6, 1), 300.0), [[17]]])
    names = "u_q,u_d,motor_speed,i_d,i_q,torque,coolant,ambient,stator_winding,stator_tooth,stator_yoke,pm,profile_id"
    lines = (",".join(f"{value:.12g}" for value in row) for row in np.hstack([other, session, session[:, :9]]).T)
    return "\n".join([names, *lines, ""]).encode()


def written(folder, contents):
    """Write files by their names; return their paths."""
    paths = [Path(folder) / name for name in contents]
    for path, content in zip(paths, contents.values(), strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return paths
