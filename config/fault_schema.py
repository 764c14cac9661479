"""The schema of faults that a twin's YAML puts into its source."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from .fields import Count, Number, Seconds, Section, SomeSeconds, Text


class FaultSection(Section):
    """A fault that is put into what the source says, or into a simulated asset; the estimator is not told.

    It is of a `sensor`, an `input` or, of kind model, a `parameter`; without any of them it is of the whole source. Its
    begin and end are stamped into the log.
    """

    kind: Literal[
        "bias", "drift", "scale", "stuck", "spike", "noise", "quantisation", "dropout", "silence", "delay", "jitter",
        "bursts", "reorder", "duplicate", "clock_jump", "clock_drift", "swap", "model", "outliers",
    ]  # fmt: skip
    """bias: `size` is added. drift: `size` is added for every second since `start`. scale: times `size`. stuck: the
    value before `start` is repeated. spike (outliers is its older name): with probability `rate` a draw of that
    standard deviation, `size`, is added. noise: a draw of that standard deviation is added to each. quantisation:
    rounded to multiples of `size`. dropout: with probability `rate` a reading arrives empty. silence: nothing arrives.
    delay: arrives `size` seconds later. jitter: later by random seconds of that mean, `size`. bursts: arrives together,
    every `every` seconds. reorder: with probability `rate` it arrives after the next one. duplicate: with probability
    `rate` it is said `count` times more, `every` seconds apart. clock_jump: stamped `size` seconds ahead. clock_drift:
    the clock gains `size` seconds a second. swap: readings of `sensor` come as those of `other`. model: the true
    parameter of a simulated asset is multiplied by `size`."""
    sensor: Text | None = None
    """The sensor's name."""
    input: Text | None = None
    """The input's name."""
    parameter: Text | None = None
    """The true parameter's name."""
    row: Text | None = None
    """The row of the sensor that fails. Default: null, all."""
    other: Text | None = None
    """The sensor with which `sensor` is swapped."""
    start: SomeSeconds = 0.0
    """Seconds after the first event at which it begins. Default: 0."""
    end: Seconds | None = None
    """Seconds after the first event at which it ends. Default: null, never."""
    size: Number | None = None
    """How much: in the unit of the row or input (drift: a second), a factor, or seconds, as the kind says."""
    rate: Number | None = None
    """Probability, a reading. Needed by spike; otherwise the default is 1."""
    every: Number | None = None
    """Seconds: of bursts between two arrivals, of duplicate between two repetitions. Default: of duplicate 0."""
    count: Count | None = None
    """Repetitions of a duplicate. Default: 1."""
    seed: Annotated[int, Field(strict=True, ge=0)] | None = None
    """Seed of its draws. Default: null, that of the simulated asset and the fault's place in the list."""
