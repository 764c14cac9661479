"""Estimates of a fold as a bag of ROS 2 (MCAP), in messages that every ROS 2 installation knows.

- `/TWIN/estimate`, sensor_msgs/JointState, one message per row of the track: `name` are the states, `position` their
  mean, `effort` their standard deviation, `velocity` is empty. It is the only standard message with names and several
  numbers for each.
- `/TWIN/smoothed`, the same of a smoothed fold.
- `/TWIN/covariance`, std_msgs/Float64MultiArray, n × n in the order of the names, row-major, where the track has it.

Stamps and times of recording are those of the measurements. Needs `nisus[robotics]`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import IO

import numpy as np

from app.twin.twin import Twin
from estimators.diagnostics.references import shown_track
from estimators.errors import ConfigError
from estimators.fold import Fold
from estimators.model.state_space import StateSpaceModel
from estimators.smoothing.walk import Smoothed
from estimators.track import Track

from .bag import NEEDS

JOINT_STATE, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"


def bag_writer(path: Path) -> Callable[..., None]:
    """Return `write_bag`; refuse a bag that cannot be written, before minutes of work.

    Raises:
        ConfigError: If a package is missing.
    """
    try:
        import mcap.writer  # noqa: F401
        import rosbags.typesys  # noqa: F401
    except ModuleNotFoundError:
        raise ConfigError(f"--out {path}: {NEEDS}") from None
    return write_bag


def covariances(model: StateSpaceModel, track: Track, pairs: np.ndarray) -> np.ndarray | None:
    """Return the covariance of the shown states, (N, n, n); None unless the track has that of every pair, (k, 2)."""
    shown = {int(j): k for k, j in enumerate(model.shown)}
    n = len(shown)
    found = np.full((len(track.mean), n, n), np.nan)
    known = np.eye(n, dtype=bool)
    found[:, range(n), range(n)] = track.std**2
    for column, (i, j) in enumerate(pairs.tolist()):
        if i in shown and j in shown:
            a, b = shown[i], shown[j]
            found[:, a, b] = found[:, b, a] = track.cross[:, column]
            known[a, b] = known[b, a] = True
    return found if known.all() else None


def write_bag(file: IO[bytes], twin: Twin, fold: Fold, smoothed: Smoothed | None = None) -> None:
    """Write the rows of a fold to an open file; the mean of a withheld state is NaN."""
    from mcap.writer import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    make = store.types
    model, track = twin.model, fold.track
    cov = covariances(model, track, fold.pairs)
    root = re.sub(r"\W", "_", twin.name)
    root = f"/_{root}" if root[:1].isdigit() else f"/{root}"
    writer = Writer(file)
    writer.start(profile="ros2", library="nisus")

    def channel(topic: str, kind: str) -> int:
        text = store.generate_msgdef(kind, ros_version=2)[0].encode()
        schema = schemas.setdefault(kind, 0) or writer.register_schema(kind, "ros2msg", text)
        schemas[kind] = schema
        return writer.register_channel(f"{root}/{topic}", "cdr", schema)

    schemas: dict[str, int] = {}
    names = [model.state_names[j] for j in model.shown]
    n = len(names)
    states = [(channel("estimate", JOINT_STATE), shown_track(model, track).mean, track.std)]
    if smoothed is not None:
        states.append((channel("smoothed", JOINT_STATE), smoothed.mean, smoothed.std))
    matrix = channel("covariance", ARRAY) if cov is not None else 0
    dimension, label = make["std_msgs/msg/MultiArrayDimension"], ",".join(names)
    axes = [dimension(label=label, size=n, stride=stride) for stride in (n * n, n)]
    square = make["std_msgs/msg/MultiArrayLayout"](dim=axes, data_offset=0)
    empty = np.zeros(0)
    for k, t in enumerate(fold.log.events.t.tolist()):
        stamp = make["builtin_interfaces/msg/Time"](sec=t // 10**9, nanosec=t % 10**9)
        header = make["std_msgs/msg/Header"](stamp=stamp, frame_id="")
        logged = max(t, 0)  # Times of recording have no sign.
        for which, centre, spread in states:
            message = make[JOINT_STATE](
                header=header, name=names, position=np.ascontiguousarray(centre[k]), velocity=empty,
                effort=np.ascontiguousarray(spread[k]),
            )  # fmt: skip
            data = bytes(store.serialize_cdr(message, JOINT_STATE))
            writer.add_message(which, logged, data, logged)
        if cov is not None:
            data = bytes(store.serialize_cdr(make[ARRAY](layout=square, data=cov[k].ravel()), ARRAY))
            writer.add_message(matrix, logged, data, logged)
    writer.finish()
