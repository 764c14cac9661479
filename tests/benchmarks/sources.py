"""What it costs to read a recorded CAN log."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from estimators.log import READING
from sources.can.decoder import Decoder
from sources.can.log import CanLog
from sources.source import Channel

from .timing import both, judged

ROOT = Path(__file__).resolve().parents[2]
BOUND = 3.0


def wheels() -> list[Channel]:
    """Four wheel speeds, one sensor each."""
    return [
        Channel(
            kind=READING,
            index=k,
            name=f"wheel {name}",
            signals=(f"WHEEL_SPEED_{name}",),
            message="WHEEL_SPEEDS",
            units=(None,),
            model_units=("m/s",),
        )
        for k, name in enumerate(("FR", "FL", "RR", "RL"))
    ]


def blf() -> None:
    """The RAV4's minute: 98,800 frames, of which the wheel speeds are decoded."""
    folder = Path(os.environ.get("NISUS_DATA") or ROOT.parent / "shared" / "data") / "can_comma2k19_rav4"
    if not folder.exists():
        print(f"BLF: skipped, no recording in {folder}; set NISUS_DATA to the folder that holds can_comma2k19_rav4")
        return
    times, frames, events = [], 0, 0

    def read() -> None:
        nonlocal frames, events
        decoder = Decoder([(folder / "dbc" / "toyota_2017.dbc", 0)], wheels(), width=1)
        source = CanLog([folder / "rav4_2018-08-02_seg40.blf"], decoder)
        events = 0
        while (batch := source.read(1.0)) is not None:
            events += len(batch)
        frames = source.frames
        source.close()

    for _ in range(3):
        times.append(both(read))
    clock, processor = np.median(times, axis=0)
    print(f"BLF, {frames:,} frames loaded, {events:,} readings decoded, seconds")
    verdict = judged(clock, BOUND, at_least=False)
    print(f"  {'median of 3':15s} {clock:9.3f}   <= {BOUND:.0f}   {verdict}   (processor {processor:.3f})")
