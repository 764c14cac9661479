"""What an MF4 file's blocks promise: how many bytes of records they hold, against those of the records that were read.

asammdf stops at a record that it does not know, and takes a group's count as it stands, without a word.

Source: ASAM MDF 4.1, blocks HD, DG, CG, DT, DZ, DL and HL.
"""

from __future__ import annotations

import struct
from typing import Any

VLSD = 1
"""Flag of a channel group whose records are of varying length."""

_HEADER = struct.Struct("<4sIQQ")


def lost_records(mdf: Any, content: Any) -> str:
    """What of the records of an opened file was not read, or nothing.

    Args:
        mdf: asammdf's file, opened.
        content: Its bytes, as asammdf completed them.
    """
    groups: dict[int, list[Any]] = {}
    for group in mdf.groups:
        groups.setdefault(int(group.data_group.address), []).append(group)
    if mdf.version < "4":
        return ""
    lost = kept = records = 0
    for members in groups.values():
        data = members[0].data_group
        if any(group.channel_group.flags & VLSD and _has_data(group) for group in members):
            continue  # Their lengths are known from within only.
        try:
            promised = _size(content, int(data.data_block_addr), set())
        except (struct.error, ValueError) as error:
            return f"a block of records cannot be found: {error}"
        fixed = [group.channel_group for group in members if not group.channel_group.flags & VLSD]
        head = int(data.record_id_len)
        sizes = [head + int(item.samples_byte_nr) + int(item.invalidation_bytes_nr) for item in fixed]
        cycles = [int(item.cycles_nr) for item in fixed]
        taken = sum(size * count for size, count in zip(sizes, cycles, strict=True))
        if promised is None:
            continue
        kept += taken
        records += sum(cycles)
        lost += abs(promised - taken)
    if not lost:
        return ""
    about = f", about {max(1, round(lost * records / kept))} records," if kept else ""
    return f"{lost} of {kept + lost} bytes of records{about} were not read"


def _has_data(group: Any) -> bool:
    return any(bool(blocks) for blocks in (group.signal_data or ()))


def _block(content: Any, address: int) -> tuple[bytes, int, tuple[int, ...]]:
    """A block's name, its length, and where its links point."""
    name, _, length, links = _HEADER.unpack_from(content, address)
    if links > len(content) // 8:
        raise ValueError(f"the block at {address:#x} has {links} links")
    return name, length, struct.unpack_from(f"<{links}Q", content, address + _HEADER.size)


def _size(content: Any, address: int, seen: set[int]) -> int | None:
    """Bytes of records in a data block, or in all of a list of them; None if they are stored by column."""
    total = 0
    waiting = [address]
    while waiting:
        address = waiting.pop()
        if not address:
            continue
        if address in seen:
            raise ValueError(f"the block at {address:#x} is linked to twice")
        seen.add(address)
        name, length, links = _block(content, address)
        if name == b"##DT":
            total += length - _HEADER.size
        elif name == b"##DZ":
            total += struct.unpack_from("<Q", content, address + _HEADER.size + 8)[0]
        elif name == b"##HL":
            waiting += links[:1]
        elif name == b"##DL":
            waiting += links
        elif name in (b"##DV", b"##LD"):
            return None
        else:
            raise ValueError(f"there is no block of data at {address:#x}")
    return total
