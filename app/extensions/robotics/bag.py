"""Bags of ROS 2, MCAP or SQLite: every message is a row, its numeric fields are columns.

A column is the topic and the path of a field (`message_fields.py`): `/odom.twist.twist.linear.x`. `time` is the stamp
of a message's header, or the time at which it was recorded if it has none or that is zero.

mcap reads the container, also one without an index, as a recorder leaves it that was killed; rosbags refuses these, and
those of another profile than ros2. rosbags reads SQLite, parses the definitions of messages and decodes CDR.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from estimators.errors import SourceError
from sources.archives import is_compressed
from sources.formats import suffix_of
from sources.tables.binary import readable
from sources.tables.rows import TableFormat
from sources.tables.text import CHUNK_ROWS, UNREADABLE, Chunk, Column, Problem, column_of
from sources.worker_process import gist

from .message_fields import BagTopic, Declared, MessageField, topics_of

ENDINGS = (".mcap", ".db3")  # Of the files of a bag

TIME = "time"  # Column of the times

MAX_SCANNED = 1000  # Messages of a topic in which names and lengths of arrays are sought

CUT = ("EndOfFile", "error")  # Errors of mcap and struct at the end of a file whose recorder was killed

NEEDS = "a ROS 2 bag needs mcap and rosbags: pip install 'nisus[robotics]'"

Messages = Callable[[Collection[str]], Iterator[tuple[str, str, int, bytes]]]
"""messages(topics): topic, type, time of recording (ns) and bytes of each message."""


def files_in(folder: Path) -> list[Path]:
    """Return the recordings of a folder that is a bag, in their order.

    Raises:
        SourceError: If the bag does not name its recordings, or they are compressed as files.
    """
    import yaml

    content = folder / "metadata.yaml"
    try:
        info = yaml.safe_load(content.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
        files = [folder / Path(name).name for name in info["relative_file_paths"]]
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError):
        raise SourceError(f"{content}: does not list the files of the bag; name its .mcap or .db3 files") from None
    for file in files:
        if file.suffix not in ENDINGS:
            raise SourceError(f"{file}: is no {' or '.join(ENDINGS)}; if it is compressed, unpack it and name the file")
    return files


def bag_names(path: Path, time: str = "") -> list[str]:
    """Return the columns of a bag.

    Raises:
        SourceError: If it cannot be read, or has no messages with fields that are numbers.
    """
    with _bag(path) as (declared, messages):
        topics = topics_of(path, declared)
        wanted = {name for name, topic in topics.items() if any(field.array for field in topic.fields.values())}
        arrays: dict[tuple[str, str], dict[str, None]] = {}
        for name, message in _first(topics, wanted, messages):
            for key, field in topics[name].fields.items():
                if field.array:
                    arrays.setdefault((name, key), {}).update(dict.fromkeys(field.elements(message)))
    found = [TIME]
    for name, topic in topics.items():
        for key, field in topic.fields.items():
            elements = arrays.get((name, key), {})
            found += [f"{name}.{key}[{one}]" for one in elements] if field.array else [f"{name}.{key}"]
    return found


def _first(topics: dict[str, BagTopic], wanted: set[str], messages: Messages) -> Iterator[tuple[str, object]]:
    """Yield topic and message of the first messages of some topics, as far as they can be read."""
    left = dict.fromkeys(wanted, MAX_SCANNED)
    with suppress(Exception):  # Reading it reports where it is damaged.
        for name, kind, _, data in messages(wanted) if wanted else ():
            if left[name] and kind == topics[name].type:
                left[name] -= 1
                with suppress(Exception):
                    yield name, topics[name].decode(data)
            elif not any(left.values()):
                return


def read_bag(path: Path, time: str, columns: Sequence[Column], problem: Problem) -> Generator[Chunk, None, None]:
    """Yield the messages of the topics of these columns; columns that a message lacks are blank.

    Raises:
        SourceError: If the bag cannot be read, or not any further.
    """
    import pyarrow

    t: list[int] = []
    values, blank = np.full((CHUNK_ROWS, len(columns)), np.nan), np.ones((CHUNK_ROWS, len(columns)), np.bool_)
    count = 0

    def chunk() -> Chunk:
        n = len(t)
        stamps = pyarrow.array(t, pyarrow.timestamp("ns", "UTC"))
        made = Chunk(np.arange(count - n, count) + 1, stamps, values[:n].copy(), blank[:n].copy())
        t.clear()
        values[:n], blank[:n] = np.nan, True
        return made

    if time != TIME:
        raise SourceError(
            f"{path}: the times of a bag are in its column {TIME!r}, not {time!r}; give time: {{column: {TIME}}}"
        )
    with _bag(path) as (declared, messages):
        topics = topics_of(path, declared)
        picks: dict[str, list[tuple[int, MessageField, str]]] = {}
        for k, column in enumerate(columns):
            if not isinstance(column, str):
                text = f"{column.column} holds numbers, not text; give a number"
                raise SourceError(f"{path}: {text}")
            name, _, key = column_of(column).partition(".")
            field = topics[name].fields.get(key)
            element = ""
            if field is None:
                key, _, element = key.removesuffix("]").partition("[")
                field = topics[name].fields[key]
            picks.setdefault(name, []).append((k, field, element))
        end = ""
        try:
            for name, kind, logged, data in messages(picks):
                count += 1
                topic = topics[name]
                try:
                    if kind != topic.type:
                        raise ValueError(f"its type is {kind}, and that of others {topic.type}")
                    message = topic.decode(data)
                    row = [(k, field.value(message, element)) for k, field, element in picks[name]]
                except Exception as error:  # noqa: BLE001  what a decoder raises of random bytes has no common base
                    problem(UNREADABLE, count, f"a message of {name} cannot be decoded ({gist(error)}); it is left out")
                    count -= 1
                    continue
                for k, value in row:
                    if value is not None:
                        values[len(t), k], blank[len(t), k] = value, False
                t.append(_time(topic, message, logged))
                if len(t) == CHUNK_ROWS:
                    yield chunk()
        except Exception as error:  # noqa: BLE001  libraries raise anything
            end = "it is cut short" if type(error).__name__ in CUT else gist(error)
        yield chunk()
        if end:
            raise SourceError(f"{path}: {end}; check that it is complete")


BAG = TableFormat(bag_names, read_bag, sparse=True)


def _time(topic: BagTopic, message: Any, logged: int) -> int:
    if topic.stamped:
        stamp = message.header.stamp
        t = int(stamp.sec) * 10**9 + int(stamp.nanosec)
        if t:
            return t
    return logged


@contextmanager
def _bag(path: Path) -> Iterator[tuple[dict[str, Declared], Messages]]:
    """Open a bag: the topics that have messages, and its messages."""
    if is_compressed(path):
        raise SourceError(f"{path}: a compressed bag is not read; decompress it (MCAP compresses its own chunks)")
    try:
        import mcap.reader  # noqa: F401
        import rosbags.rosbag2
    except ModuleNotFoundError:
        raise SourceError(f"{path}: {NEEDS}") from None
    if suffix_of(path) == ".mcap":
        with path.open("rb") as file:
            with readable(path, "MCAP"):
                opened = _indexed(file) or _streamed(path)
            yield opened
        return
    with readable(path, "a ROS 2 bag"):
        reader = rosbags.rosbag2.Reader(path)
        reader.open()
    try:
        there = [one for one in reader.connections if one.msgcount]
        declared = {
            one.topic: Declared(one.msgtype, one.ext.serialization_format, one.msgdef.format.name, one.msgdef.data)  # type: ignore[union-attr]
            for one in there
        }

        def messages(topics: Collection[str]) -> Iterator[tuple[str, str, int, bytes]]:
            for one, t, data in reader.messages([one for one in there if one.topic in topics]):
                yield one.topic, one.msgtype, t, data

        yield declared, messages
    finally:
        reader.close()


def _indexed(file: IO[bytes]) -> tuple[dict[str, Declared], Messages] | None:
    """Return topics and messages of an MCAP by its index; None without one."""
    from mcap.reader import SeekingReader

    reader = SeekingReader(file, validate_crcs=True)
    try:
        summary = reader.get_summary()
    except Exception:  # noqa: BLE001  a file that is cut has anything in the place of the index
        return None
    if summary is None or summary.statistics is None or not summary.chunk_indexes:
        return None
    counts = summary.statistics.channel_message_counts
    declared = {
        channel.topic: _declared(channel, summary.schemas.get(channel.schema_id))
        for channel in summary.channels.values()
        if counts.get(channel.id)
    }

    return declared, lambda topics: map(_row, reader.iter_messages(list(topics)))


def _streamed(path: Path) -> tuple[dict[str, Declared], Messages]:
    """Return topics and messages of an MCAP from its start to where it ends or is damaged."""
    from mcap.reader import NonSeekingReader

    declared: dict[str, Declared] = {}

    def records(topics: Collection[str] | None = None) -> Iterator[tuple[Any, Any, Any]]:
        with path.open("rb") as file:
            yield from NonSeekingReader(file, validate_crcs=True).iter_messages(topics, log_time_order=False)

    try:
        for schema, channel, _ in records():
            if channel.topic not in declared:
                declared[channel.topic] = _declared(channel, schema)
    except Exception:  # noqa: BLE001  libraries raise anything
        if not declared:
            raise
    return declared, lambda topics: map(_row, records(topics))


def _row(record: tuple[Any, Any, Any]) -> tuple[str, str, int, bytes]:
    schema, channel, message = record
    return channel.topic, schema.name if schema else "", message.log_time, message.data


def _declared(channel: Any, schema: Any) -> Declared:
    formats = {"ros2msg": "MSG", "ros2idl": "IDL", "omgidl": "IDL"}
    if schema is None:
        return Declared("", channel.message_encoding, "NONE", "")
    kind = formats.get(schema.encoding, "NONE")
    return Declared(schema.name, channel.message_encoding, kind, schema.data.decode("utf-8", "replace"))
