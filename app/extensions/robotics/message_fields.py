"""Numeric fields of ROS 2 messages by their paths, from the definitions of their types.

The path of a field is `twist.twist.linear.x`; of an element of an array it ends in its number from 0, or in its name
where the message has a `name` for each: `position[elbow]`. A covariance matrix gives its diagonal,
`pose.covariance.x`; a quaternion also `roll`, `pitch` and `yaw` in radians.

rosbags parses the definitions and decodes CDR.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from io import BytesIO
from operator import attrgetter, getitem
from pathlib import Path
from typing import Any, NamedTuple

from estimators.errors import SourceError
from sources.worker_process import gist

MAX_ELEMENTS = 64  # Elements up to which an array has a column each; longer ones are images, scans and the like

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""Order of the diagonal of a covariance (REP 103); of a position, x is east and y north."""

ZSTD = b"\x28\xb5\x2f\xfd"  # First bytes of a message that rosbag2 has compressed

HEADER = "std_msgs/msg/Header"

NO_VALUES = (HEADER, "std_msgs/msg/MultiArrayLayout")  # Types whose numbers are not data

Test = Callable[[object], bool]


class MessageField(NamedTuple):
    """Numeric field of a message.

    `get` returns its value, or its array; `names` the names of the elements, or None where they have numbers. The value
    is missing if one of `invalid` holds of the message.
    """

    get: Callable
    invalid: tuple[Test, ...] = ()
    array: bool = False
    names: Callable[[object], Sequence[str]] | None = None

    def elements(self, message: object) -> Sequence[str]:
        """Return the names or numbers of the elements of an array in this message; none if it is too long."""
        count = len(self.get(message))
        names = self.names(message) if self.names is not None else ()
        if count > MAX_ELEMENTS:
            return ()
        return names if len(names) == count else [str(k) for k in range(count)]

    def value(self, message: object, element: str) -> float | None:
        """Return the value, NaN if it is invalid, None if this message does not have the element."""
        found = self.get(message)
        if self.array:
            elements = self.elements(message)
            if element not in elements:
                return None
            found = found[list(elements).index(element)]
        return math.nan if any(test(message) for test in self.invalid) else float(found)


class BagTopic(NamedTuple):
    """Topic of a bag: the type of its messages, their decoder, their fields, and whether they have a header."""

    type: str
    decode: Callable[[bytes], object]
    fields: dict[str, MessageField]
    stamped: bool


class Declared(NamedTuple):
    """Topic as a bag declares it: type, encoding of its messages, and format (MSG, IDL, NONE) and text of the type."""

    type: str
    encoding: str
    format: str
    text: str


def topics_of(path: Path, declared: dict[str, Declared]) -> dict[str, BagTopic]:
    """Return the topics whose messages can be decoded and have numbers, in the order of their names.

    Raises:
        SourceError: If there is none.
    """
    from rosbags.typesys import Stores, get_typestore

    found, reasons = {}, []
    for name, one in sorted(declared.items()):
        try:
            if one.encoding != "cdr":
                raise ValueError(f"its messages are encoded as {one.encoding or 'nothing known'}, and only CDR is read")
            if one.format == "NONE":
                store = get_typestore(Stores.LATEST)
            else:
                store = get_typestore(Stores.EMPTY)
                store.register(_types(one))
            if one.type not in store.fielddefs:
                raise ValueError(f"the bag does not define its type {one.type}")
            fields, stamped = _fields(store.fielddefs, one.type), _stamped(store.fielddefs, one.type)
        except Exception as error:  # noqa: BLE001  what a parser raises has no common base
            reasons.append(f"{name}: {gist(error)}")
            continue
        if fields:
            found[name] = BagTopic(one.type, _decoder(store, one.type), fields, stamped)
    if not found:
        why = "; ".join(reasons[:3]) or ("its messages hold no numbers" if declared else "it holds no messages")
        raise SourceError(f"{path}: has no columns; {why}")
    return found


def _types(one: Declared) -> Any:
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    if one.format == "MSG":
        return get_types_from_msg(one.text, one.type)
    line = "=" * 80 + "\n"
    parts = [part.partition("\n")[2] for part in one.text.split(line)[1:]] if one.text.startswith(line) else [one.text]
    return {name: kind for part in parts for name, kind in get_types_from_idl(part).items()}


def _decoder(store: Any, kind: str) -> Callable[[bytes], object]:
    def decode(data: bytes) -> object:
        if data[:4] == ZSTD:
            import pyarrow  # Here, not above: it takes long, and most messages are not compressed.

            data = pyarrow.input_stream(BytesIO(data), compression="zstd").read()
        return store.deserialize_cdr(data, kind)

    return decode


def _stamped(types: Any, kind: str) -> bool:
    return any(name == "header" and form[1] == HEADER for name, form in types[kind][1])


def _fields(types: Any, kind: str, prefix: str = "", invalid: tuple[Test, ...] = ()) -> dict[str, MessageField]:
    """Return the numeric fields of a type by their path."""
    from rosbags.interfaces import Nodetype

    found: dict[str, MessageField] = {}
    members, texts = dict(types[kind][1]), ((Nodetype.BASE, ("string", 0)), 0)
    fix = kind == "sensor_msgs/msg/NavSatFix"
    named = next((name for name in ("name", "names") if members.get(name) == (Nodetype.SEQUENCE, texts)), None)
    names = attrgetter(prefix + named) if named is not None else None
    for name, (node, form) in members.items():
        path, tests = prefix + name, invalid
        if f"{name}_covariance" in members:
            tests = (*tests, _unknown(f"{path}_covariance"))
        if fix and name in ("latitude", "longitude", "altitude"):
            tests = (*tests, _test(f"{prefix}status.status", lambda status: status < 0))
        if node == Nodetype.NAME and form not in NO_VALUES:
            found |= _fields(types, form, f"{path}.", tests)
            if form == "geometry_msgs/msg/Quaternion":
                found |= {f"{path}.{axis}": MessageField(_part(path, angle, axis), tests) for axis in AXES[3:]}
        elif node == Nodetype.BASE and form[0] not in ("string", "wstring"):
            if name != "structure_needs_at_least_one_member":
                found[path] = MessageField(attrgetter(path), tests)
        elif node in (Nodetype.ARRAY, Nodetype.SEQUENCE) and form[0][0] == Nodetype.BASE:
            base, length = form[0][1][0], form[1]
            fixed = node == Nodetype.ARRAY
            if base in ("string", "wstring") or (fixed and length > MAX_ELEMENTS):
                continue
            if name.endswith("covariance") and fixed and length in (9, 36):
                tests = (*tests, _unknown(path))
                if fix:
                    tests = (*tests, _test(f"{path}_type", lambda known: known == 0))
                size = math.isqrt(length)
                for k in range(size):
                    found[f"{path}.{AXES[k]}"] = MessageField(_part(path, getitem, k * (size + 1)), tests)
            else:
                found[path] = MessageField(attrgetter(path), tests, array=True, names=None if fixed else names)
    return found


def _part(path: str, of: Callable[..., float], key: str | int) -> Callable[[object], float]:
    get = attrgetter(path)
    return lambda message: of(get(message), key)


def _test(path: str, rule: Callable[..., bool]) -> Test:
    get = attrgetter(path)
    return lambda message: rule(get(message))


def _unknown(path: str) -> Test:
    """Return the test of a covariance whose first element is -1: the quantity is not measured (sensor_msgs/Imu)."""
    return _test(path, lambda matrix: bool(matrix[0] == -1.0))


def angle(q: Any, axis: str) -> float:
    """Return roll, pitch or yaw of a quaternion, rad: turns about the fixed x, then y, then z axis (REP 103).

    roll = atan2(2 (wx + yz), w² - x² - y² + z²);  pitch = asin(2 (wy - xz) / |q|²);
    yaw = atan2(2 (wz + xy), w² + x² - y² - z²);  NaN of a quaternion of zeros.
    """
    w, x, y, z = q.w, q.x, q.y, q.z
    length = w * w + x * x + y * y + z * z
    if not length > 0.0:
        return math.nan
    if axis == "roll":
        return math.atan2(2 * (w * x + y * z), w * w - x * x - y * y + z * z)
    if axis == "yaw":
        return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return math.asin(max(-1.0, min(1.0, 2 * (w * y - x * z) / length)))
