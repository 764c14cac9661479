"""Signals of CAN messages as tables, and the compiled loop that extracts their values from frames.

The same loop serves a live bus, a few frames at a time, and recordings, thousands at a time.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import types

from estimators.numerics.jit import B1, F1, F2, I1, jit

from ..mapping import ABSENT, PRESENT, SHORT

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

UNSIGNED, SIGNED, FLOAT32, FLOAT64 = range(4)


class Signals(NamedTuple):
    """Signals of all messages, one a row; those of message m are rows first[m] to first[m + 1].

    `start` counts bits from the least significant bit of byte 0 for little-endian signals, and from the most
    significant one of byte 0 for big-endian ones. `parent` is the multiplexer's position within the message, or -1;
    ids[ids_first[s]:ids_first[s + 1]] are its values with which the frame carries the signal, and
    known[known_first[s]:known_first[s + 1]] the values that a multiplexer s may have at all.
    """

    first: np.ndarray
    start: np.ndarray
    length: np.ndarray
    big: np.ndarray
    kind: np.ndarray
    scale: np.ndarray
    offset: np.ndarray
    parent: np.ndarray
    ids: np.ndarray
    ids_first: np.ndarray
    known: np.ndarray
    known_first: np.ndarray


_columns = {"big": types.bool_[::1], "scale": F1, "offset": F1}
signals_type = types.NamedTuple([_columns.get(name, I1) for name in Signals._fields], Signals)
extract_signature = types.void(
    signals_type, I1, I1, types.Array(types.uint8, 2, "C"), F2, types.Array(types.int8, 2, "C"), B1
)


@jit
def _bits(data: np.ndarray, i: int, start: int, length: int, big: bool) -> np.uint64:
    """Return `length` bits of frame i as an unsigned integer."""
    raw = np.uint64(0)
    got = 0
    position = start
    while got < length:
        byte = np.uint64(data[i, position >> 3])
        shift = position & 7
        take = min(8 - shift, length - got)
        mask = np.uint64((1 << take) - 1)
        if big:
            raw = (raw << np.uint64(take)) | ((byte >> np.uint64(8 - shift - take)) & mask)
        else:
            raw = raw | (((byte >> np.uint64(shift)) & mask) << np.uint64(got))
        got += take
        position += take
    return raw


@jit
def extract(signals, plan, length, data, values, state, bad):
    """Compute the physical values of every signal of every frame.

    Args:
        signals: The tables.
        plan: Message of each frame, (n,); frames with -1 are left out.
        length: Bytes of each frame, (n,).
        data: Their bytes, (n, at least the longest message), zeros after the end.
        values: Filled, (n, signals of a message): physical value, NaN where there is none.
        state: Filled, same shape: PRESENT, ABSENT or SHORT.
        bad: Filled, (n,): 1 where a multiplexer has a value that the database lacks, 2 where the frame ends
            before a multiplexer.
    """
    as_bits = np.zeros(1, np.uint64)
    as_double = as_bits.view(np.float64)
    as_half_bits = np.zeros(1, np.uint32)
    as_single = as_half_bits.view(np.float32)
    raws = np.zeros(max(1, values.shape[1]), np.int64)
    for i in range(plan.size):
        bad[i] = 0
        m = plan[i]
        if m < 0:
            continue
        for j in range(signals.first[m + 1] - signals.first[m]):
            s = signals.first[m] + j
            values[i, j] = np.nan
            parent = signals.parent[s]
            if parent >= 0:
                here = False
                if state[i, parent] == PRESENT:
                    for k in range(signals.ids_first[s], signals.ids_first[s + 1]):
                        if signals.ids[k] == raws[parent]:
                            here = True
                            break
                if not here:
                    state[i, j] = ABSENT
                    continue
            n = signals.length[s]
            multiplexer = signals.known_first[s + 1] > signals.known_first[s]
            if signals.start[s] + n > 8 * length[i]:
                state[i, j] = SHORT
                if multiplexer:
                    bad[i] = 2
                continue
            state[i, j] = PRESENT
            raw = _bits(data, i, signals.start[s], n, signals.big[s])
            kind = signals.kind[s]
            if kind == UNSIGNED:
                value = float(raw)
                raws[j] = np.int64(raw)
            elif kind == SIGNED:
                integer = np.int64(raw)
                if n < 64 and (raw >> np.uint64(n - 1)) & np.uint64(1):
                    integer = integer - (np.int64(1) << np.int64(n))
                value = float(integer)
                raws[j] = integer
            elif kind == FLOAT32:
                as_half_bits[0] = np.uint32(raw)
                value = float(as_single[0])
            else:
                as_bits[0] = raw
                value = as_double[0]
            values[i, j] = value * signals.scale[s] + signals.offset[s]
            if multiplexer:
                known = False
                for k in range(signals.known_first[s], signals.known_first[s + 1]):
                    if signals.known[k] == raws[j]:
                        known = True
                        break
                if not known:
                    bad[i] = 1


def vectorises(signal: Signal) -> bool:
    """Return whether `extract` gives the values of cantools; otherwise cantools decodes the message, frame by frame."""
    conversion = signal.conversion
    whole = float(conversion.scale).is_integer() and float(conversion.offset).is_integer()
    if signal.is_float:
        return signal.length in (32, 64)
    if signal.length > 64:
        return False
    # cantools keeps integers exact, which may have more digits than a float.
    identity = conversion.scale == 1 and conversion.offset == 0
    return identity or not whole or signal.length + int(abs(conversion.scale)).bit_length() <= 52


def ordered(message: Message, names: tuple[str, ...]) -> list[Signal]:
    """Return the signals of these names and their multiplexers, each multiplexer before the signals that it selects."""
    by_name = {signal.name: signal for signal in message.signals}
    found: dict[str, Signal] = {}

    def visit(name: str) -> None:
        signal = by_name[name]
        if signal.multiplexer_signal is not None:
            visit(signal.multiplexer_signal)
        found.setdefault(name, signal)

    for name in names:
        visit(name)
    return list(found.values())


def tabulate(messages: list[tuple[Message, list[Signal]]]) -> Signals:
    """Return the tables of messages (cantools) and their wanted signals, in the order of `ordered`."""
    from cantools.database.utils import start_bit  # Here, not above: processes that compile have no signals.

    tables = SimpleNamespace(**{name: [] for name in Signals._fields})
    for starts in (tables.first, tables.ids_first, tables.known_first):
        starts.append(0)
    for message, signals in messages:
        names = [signal.name for signal in signals]
        for signal in signals:
            floats = FLOAT32 if signal.length == 32 else FLOAT64
            tables.start.append(start_bit(signal))
            tables.length.append(signal.length)
            tables.big.append(signal.byte_order != "little_endian")
            tables.kind.append(floats if signal.is_float else SIGNED if signal.is_signed else UNSIGNED)
            tables.scale.append(float(signal.conversion.scale))
            tables.offset.append(float(signal.conversion.offset))
            tables.parent.append(-1 if signal.multiplexer_signal is None else names.index(signal.multiplexer_signal))
            tables.ids.extend(signal.multiplexer_ids or ())
            tables.ids_first.append(len(tables.ids))
            selected = [s for s in message.signals if s.multiplexer_signal == signal.name]
            tables.known.extend(sorted({value for s in selected for value in s.multiplexer_ids or ()}))
            tables.known_first.append(len(tables.known))
        tables.first.append(len(tables.start))
    kinds = {"big": np.bool_, "scale": np.float64, "offset": np.float64}
    return Signals(**{name: np.array(column, kinds.get(name, np.int64)) for name, column in vars(tables).items()})
