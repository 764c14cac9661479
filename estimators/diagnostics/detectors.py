"""The table of detectors: each cause of an episode with its tests, wording, remedy, severity and guide heading.

Under the model the standardised innovation e of a sensor row is N(0, 1) and white. A test is another density of e given
the value before; its log-likelihood ratio accumulates in a CUSUM (`detector_tests.py`). A test is either the five
coefficients (a, b, c, d, f) of

    log Λ = a e² + b e e₋ + c e₋² + d e + f

or a `Density`, whose log Λ is any function of e. Kernels, episodes, status, report and guide use nothing but the row
of a detector. To add a detector, add a row with its tests and a section to the guide: a row without `effect` gets
episodes of its own, whose size is the mean log Λ of its most significant test.

Source: Basseville & Nikiforov (1993), Detection of Abrupt Changes, chapters 2 and 4.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..model.state_space import Input, State

Ratio = tuple[float, float, float, float, float]


class Density(NamedTuple):
    """Test of a density of e: `log_ratio` (n,) -> (n,) is its log Λ, tabulated by compiled code.

    `outliers`: the sum returns to zero after `CALM_MEASUREMENTS` without an outlier. `rare`: it also does while another
    test of the row is in alarm.
    """

    log_ratio: Callable[[np.ndarray], np.ndarray]
    outliers: bool = False
    rare: bool = False


def scale_ratio(variance: float) -> Ratio:
    """Return the coefficients for e ~ N(0, variance)."""
    return 0.5 - 0.5 / variance, 0.0, 0.0, 0.0, -0.5 * math.log(variance)


def mean_ratio(mean: float) -> Ratio:
    """Return the coefficients for e ~ N(mean, 1)."""
    return 0.0, 0.0, 0.0, mean, -0.5 * mean * mean


def correlation_ratio(phi: float) -> Ratio:
    """Return the coefficients for e of unit variance and lag-1 correlation phi."""
    rest = 1.0 - phi * phi
    return 0.5 - 0.5 / rest, phi / rest, -0.5 * phi * phi / rest, 0.0, -0.5 * math.log(rest)


OUTLIER_SIGMA = 5.0  # Standard deviation of e of an outlier


def outlier_density(share: float, *, rare: bool = False) -> Density:
    """Return the test of a mixture in which this share of e has `OUTLIER_SIGMA` standard deviations."""

    def log_ratio(e: np.ndarray) -> np.ndarray:
        wide = np.exp(0.5 * e**2 * (1.0 - 1.0 / OUTLIER_SIGMA**2)) / OUTLIER_SIGMA
        return np.log1p(share * (wide - 1.0))

    return Density(log_ratio, outliers=True, rare=rare)


class Detector(NamedTuple):
    """One cause of episodes.

    Attributes:
        name: The cause, as episodes, JSON and the guide name it.
        wording: Text of an episode, formatted with the facts of one (`episodes/wording.py`) as field 0.
        remedy: What to do, formatted alike; follows the wording.
        effect: Quantity of an episode's size; "" where only the tests themselves are known.
        unit: Unit of the size.
        alarms: Tests by the name of their alarm, a bit of `Track.alarms`. Alarms without tests have a kernel of their
            own.
        severity: The smallest is the most urgent.
        sensor_lost: Whether the sensor carries no information on the asset meanwhile.
        isolate: Whether sensor, input and parameter are compared to find the most likely fault.
        conservative: Whether the bands are wider than necessary meanwhile: an advisory.
    """

    name: str
    wording: str = "{0.name}: {0.cause} innovations {0.since} (log-likelihood ratio {0.size:.2g} nats a measurement)"
    remedy: str = "see the guide"
    effect: str = ""
    unit: str = ""
    alarms: Mapping[str, tuple[Ratio | Density, ...]] = MappingProxyType({})
    severity: int = 5
    sensor_lost: bool = False
    isolate: bool = False
    conservative: bool = False

    @property
    def anchor(self) -> str:
        """Anchor of its heading in the guide."""
        return anchor(self.name)

    @property
    def grade(self) -> str:
        """Health that it gives to the twin, unless the bands are valid all the same."""
        return "advisory" if self.conservative else GRADES.get(self.severity, "suspect")

    @property
    def bits(self) -> int:
        """Bits of its alarms in `Track.alarms`."""
        return sum(bit_of(name) for name in self.alarms)

    def text(self, facts: object) -> str:
        """Return the sentence of an episode with these facts."""
        wording, remedy = self.wording.format(facts), self.remedy.format(facts)
        return f"{wording}{';' if ':' in wording else ':'} {remedy}"


GRADES = {0: "diverged", 1: "stale", 2: "degraded"}  # Health by the severity of a detector; suspect for others


def anchor(heading: str) -> str:
    """Return the anchor that Markdown makes of a heading."""
    return heading.lower().replace(" ", "-")


CALENDAR_FROM_S = 1e8
"""Seconds from which a time is one of the calendar (after 1973), not one since the start of a recording."""


def since(seconds: float) -> str:
    """Return "since ..." with date and time of day, or with seconds of the log."""
    if seconds < CALENDAR_FROM_S:
        return f"since {seconds:.1f} s"
    return f"since {str(np.datetime64(int(seconds), 's')).replace('T', ' ')} UTC"


DETECTORS = (
    Detector(
        "narrow",
        "bands of {0.name} are too narrow {0.since}: innovations are {0.size:.2f} times as large as predicted",
        "increase {0.variance}, or check the sensor for added noise",
        effect="ratio of the standard deviation to the predicted one",
        unit="×",
        alarms={"narrow": (scale_ratio(1.5), scale_ratio(2.5), scale_ratio(6.0))},
    ),
    Detector(
        "wide",
        "bands of {0.name} are too wide {0.since}: innovations are {0.size:.2f} times as large as predicted",
        "reduce {0.variance}",
        effect="ratio of the standard deviation to the predicted one",
        unit="×",
        alarms={"wide": (scale_ratio(0.6), scale_ratio(0.3), scale_ratio(0.05))},
        conservative=True,
    ),
    Detector(
        "shifted",
        "{0.name} reads {0.offset} ({0.sigmas:.1f} σ) {0.side} the prediction {0.since}",
        "the sensor, an input or a parameter is biased; hold {0.sensor} out to compare",
        effect="mean of e",
        unit="σ",
        alarms={
            "shifted up": (mean_ratio(0.2), mean_ratio(0.5), mean_ratio(1.5)),
            "shifted down": (mean_ratio(-0.2), mean_ratio(-0.5), mean_ratio(-1.5)),
        },
        severity=3,
        isolate=True,
    ),
    Detector(
        "correlated",
        "innovations of {0.name} are correlated ({0.size:+.2f}) {0.since}",
        "increase {0.process_noise}, or add the missing state to the model",
        effect="lag-1 correlation",
        alarms={"correlated": (correlation_ratio(0.25), correlation_ratio(0.6))},
    ),
    Detector(
        "alternating",
        "innovations of {0.name} alternate in sign ({0.size:+.2f}) {0.since}",
        "reduce {0.process_noise}; the estimate follows the noise",
        effect="lag-1 correlation",
        alarms={"alternating": (correlation_ratio(-0.25), correlation_ratio(-0.6))},
    ),
    Detector(
        "spiky",
        "{0.name} has spikes {0.since}: {0.percent:.2g} % of its measurements are outliers",
        "check the wiring, and set a gate unless the asset jumps (nisus advise tests it)",
        effect="share of |e| beyond 4 σ",
        alarms={"spiky": (outlier_density(0.03), outlier_density(0.003, rare=True))},
    ),
    Detector(
        "refused",
        "{0.name} is rejected by the gate {0.since} ({0.percent:.0f} % of its measurements)",
        "the sensor or the twin is wrong; {0.cross_check}",
        effect="share of rejected measurements",
        alarms={"refused": ()},
        severity=2,
        sensor_lost=True,
        isolate=True,
    ),
    Detector(
        "stuck",
        "{0.name} is {0.held} at {0.size:.6g}{0.spaced_unit} {0.since}: {0.observed_by}",
        "hold it out until it is repaired",
        effect="the value",
        alarms={"stuck": ()},
        severity=2,
        sensor_lost=True,
    ),
    Detector(
        "disagreeing",
        "rows of {0.sensor} contradict each other {0.since}",
        "increase R.{0.sensor}, or check which of them is wrong",
        effect="√(NIS / degrees of freedom)",
        unit="×",
        alarms={"disagreeing": ()},
    ),
    Detector(
        "agreeing",
        "rows of {0.sensor} are closer to the prediction than their noise {0.since}",
        "reduce R.{0.sensor}",
        effect="√(NIS / degrees of freedom)",
        unit="×",
        alarms={"agreeing": ()},
        conservative=True,
    ),
    Detector(
        "screened",
        "{0.name} violates its limits ({0.reasons}) {0.since}: {0.percent:.0f} % of its measurements are not used",
        "{0.observed_by}; check the sensor, or sensors.{0.sensor} in the YAML",
        effect="share of measurements beyond their limits",
        severity=2,
        sensor_lost=True,
    ),
    Detector(
        "silent",
        "{0.name} {0.dropout}: {0.observed_by}",
        "check its wiring and its bus",
        effect="duration",
        unit="s",
        severity=2,
    ),
    Detector(
        "never heard",
        "{0.name} {0.dropout}: {0.observed_by}",
        "check its channel map and its bus",
        effect="duration",
        unit="s",
        severity=2,
    ),
    Detector(
        "outside",
        "{0.name} is {0.size:.4g}{0.spaced_unit}, outside {0.limits} where the model was fitted, {0.since}",
        "bands are valid only inside; fit the model there",
        effect="the value",
    ),
    Detector(
        "impossible",
        "{0.name} is wrong {0.since}, as it reached {0.size:.4g}{0.spaced_unit} with a band beyond {0.limits}",
        "a sensor has an offset or a wrong scale, or the model is wrong: `nisus check` compares them",
        effect="the value",
    ),
    Detector(
        "corrected",
        "{0.name} is corrected {0.since} by more than its band allows, over its memory or from its prior",
        "its true value may lie outside the band, as the model or an input is wrong; `nisus check` compares them",
        effect="the value",
    ),
    Detector(
        "impoverished",
        "the particle cloud is impoverished {0.since}: {0.size:.3g} effective particles, all from {0.ancestors}",
        "use more particles, pf-ekf or pf-reg, or increase Q of the states that hardly move",
        effect="effective sample size",
    ),
    Detector(
        "stale",
        "no measurement was used {0.since}: the estimate is a prediction of the model",
        "check the source",
        effect="duration",
        unit="s",
        severity=1,
    ),
    Detector(
        "diverged",
        "the estimate has diverged {0.since}{0.contradiction}",
        "{0.reset_advice}",
        effect="duration",
        unit="s",
        severity=0,
    ),
    Detector(
        "dropped",
        "{0.percent:.3g} % of the measurements were dropped, {0.counts}: too late, or with impossible times",
        "check the times of the source, or lengthen time.max_delay",
        effect="share of measurements",
    ),
    Detector(
        "repeating",
        "{0.name} repeats its values: {0.repeats.reason}",
        "give its channel in `source` the key repeats: {0.repeats.key}",
        effect="share of measurements",
    ),
)
"""Order: the alarms, in the order of their bits in `Track.alarms`, then what is found otherwise."""

CAUSES = tuple(detector.name for detector in DETECTORS)

ALARM_NAMES = tuple(name for detector in DETECTORS for name in detector.alarms)
"""Names of the bits of `Track.alarms`, from the lowest."""


def bit_of(alarm: str) -> int:
    """Return the bit of `Track.alarms` of an alarm."""
    return 1 << ALARM_NAMES.index(alarm)


def detector_of(cause: str) -> Detector:
    """Return the row of a cause; a row of defaults for one that the table lacks."""
    return next((row for row in DETECTORS if row.name == cause), Detector(cause))


NARROW, WIDE, SHIFTED_UP, SHIFTED_DOWN = map(bit_of, ("narrow", "wide", "shifted up", "shifted down"))
CORRELATED, ALTERNATING, SPIKY = map(bit_of, ("correlated", "alternating", "spiky"))
REFUSED, STUCK, DISAGREEING, AGREEING = map(bit_of, ("refused", "stuck", "disagreeing", "agreeing"))

CONSERVATIVE = sum(detector.bits for detector in DETECTORS if detector.conservative)
"""Alarms during which bands are wider than necessary."""

SHIFTED, LAGGING = SHIFTED_UP | SHIFTED_DOWN, CORRELATED | ALTERNATING
"""Alarms of the mean and of the correlation of the innovations, which bands that are too wide may cover."""

ADVISORY_ALARM = 1 << 30
"""Bit of `Track.alarms` of a row whose bands are valid in spite of its alarms: an advisory."""

LOST = sum(detector.bits for detector in DETECTORS if detector.sensor_lost)
"""Alarms during which a sensor carries no information on the asset."""

IMPOVERISHED, OUTSIDE, FAR_OUTSIDE, IMPOSSIBLE = 1 << 59, 1 << 60, 1 << 61, 1 << 62
"""Bits of `Track.flags` above those of the sensors that dropped out: few particles carry the estimate; outside the
range in which the model was fitted, and by half of it; an impossible estimate."""

MARGIN, FAR = 0.05, 0.5  # Share of its width by which a range is left before that counts, and before it is far


def beyond_range(item: State | Input) -> list[tuple[float, float]]:
    """Return the ranges beyond which a state or input is outside that of its model, and far outside."""
    low, high = item.fitted or (-math.inf, math.inf)
    width = high - low if high - low < math.inf else 0.0  # with one end no margin, and nothing is far outside
    near = MARGIN * width if item.near is None else item.near
    far = max(FAR * width or math.inf if item.far is None else item.far, near)
    return [(low - more, high + more) for more in (near, far)]


def is_outside(item: State | Input, value: float) -> bool:
    """Return whether a value makes the twin suspect, or is not a number."""
    low, high = beyond_range(item)[0]
    return not low <= value <= high


SENSOR_FLAGS = 26  # Sensors with a bit of their own in `Track.flags`, the lowest; the others share the last
SENSOR_MASK = (1 << SENSOR_FLAGS) - 1
MEMORY_AT, MEMORY_FLAGS = SENSOR_FLAGS, 16  # First bit of the shown states, and how many of them have one
IMPOSSIBLE_AT = MEMORY_AT + MEMORY_FLAGS  # First of their bits while an impossible estimate still matters


def memory_flag(column: int, at: int = MEMORY_AT) -> int:
    """Return the bit of `Track.flags` of a shown state whose corrections are too large (memory.py), or 0."""
    return 1 << at + column if column < MEMORY_FLAGS else 0


# What follows is compiled into the kernels as constants.

_TESTS = [(bit_of(name), test) for detector in DETECTORS for name, tests in detector.alarms.items() for test in tests]
# Stable: tests that need the value before come last, as they skip the first e.
_QUADRATIC = sorted(
    ((bit, test) for bit, test in _TESTS if not isinstance(test, Density)), key=lambda item: item[1][1] != 0.0
)
_DENSITIES = [(bit, test) for bit, test in _TESTS if isinstance(test, Density)]

RATIOS = np.array([test for _, test in _QUADRATIC])
"""Coefficients (a, b, c, d, f) of the quadratic tests, (QUADRATIC, 5)."""

QUADRATIC = len(RATIOS)
LAGGED = int(np.sum(RATIOS[:, 1] != 0.0))  # Quadratic tests, and how many of them, the last, need the e before
MAX_SIGMA = 6.0  # |e| is clipped here: a more distant value carries no more evidence

GAINS, FADING = (0.2, 0.5), 0.95
"""Gains of a filter that follows noise: its innovations are (1 - L) / (1 - (1 - gain) L) of white noise, L the lag;
`FADING` in place of 1 leaves an offset to the other tests. Their lag-1 correlation is small, but they fall below white
noise at all long lags together. At unit variance, too."""


def _followed_ratio(gain: float) -> tuple[float, float, float]:
    step = 1.0 - gain - FADING
    rest = 1.0 / (1.0 + step * step / (1.0 - (1.0 - gain) ** 2))
    return step, 0.5 / rest, -0.5 * math.log(rest)


FOLLOWED = np.array([_followed_ratio(gain) for gain in GAINS])
"""Coefficients (a, b, c) of m ← fading m + a e, log Λ = ½ e² - b (e - m)² + c, (gains, 3); m predicts e."""

DENSITIES = len(_DENSITIES)
DENSITY_STEPS = 256.0  # Steps per σ of the tabulated log Λ, between which it is interpolated (error below 1e-5)

_GRID = np.arange(2.0 * MAX_SIGMA * DENSITY_STEPS + 2.0) / DENSITY_STEPS - MAX_SIGMA
DENSITY_RATIOS = np.array([test.log_ratio(_GRID) for _, test in _DENSITIES])
"""log Λ of each density from -MAX_SIGMA on, (DENSITIES, steps)."""

OUTLIER_TESTS = np.array([test.outliers for _, test in _DENSITIES])
RARE_TESTS = np.array([test.rare for _, test in _DENSITIES])
"""`Density.outliers` and `Density.rare` of each density, (DENSITIES,)."""

AT_GAINS = QUADRATIC
AT_DENSITIES = AT_GAINS + len(GAINS)
AT_REFUSALS = AT_DENSITIES + DENSITIES
AT_REPETITION = AT_REFUSALS + 1
TESTS = AT_REPETITION + 1
"""Tests of a row, in this order: quadratic ones, followed noise, densities, rejections, repetition."""

BITS = np.array(
    [*(bit for bit, _ in _QUADRATIC), *[ALTERNATING] * len(GAINS), *(bit for bit, _ in _DENSITIES), REFUSED, STUCK]
)
"""Alarm of each test of a row, (TESTS,)."""

JOINT_RATIOS = np.array([scale_ratio(variance) for variance in (1.5, 2.5, 6.0, 0.6, 0.3, 0.05)])
JOINT = len(JOINT_RATIOS)
JOINT_BITS = np.array([DISAGREEING] * 3 + [AGREEING] * 3)
"""Tests of all rows of a sensor together, by its NIS: coefficients (JOINT, 5) and alarms (JOINT,)."""

REJECTED_SHARE = 0.3  # Share of rejected readings that is tested against what the gate rejects by chance
REPEAT_PROBABILITY = 0.999  # Probability that a stuck sensor repeats its last value

UNKNOWN_QUANTUM = 0.5
"""Probability of a repeated value of a sensor that has never changed: its quantum is not known yet."""

NEW_VALUE = math.log((1.0 - REPEAT_PROBABILITY) / (1.0 - UNKNOWN_QUANTUM))
"""log Λ of a value that differs from the last one."""


def log_ratios(bits: int, e: np.ndarray) -> np.ndarray:
    """Return log Λ of the tests of these alarms at each of e (n,), finite, shape (tests, n)."""
    e = np.clip(e, -MAX_SIGMA, MAX_SIGMA)
    before = np.concatenate((np.zeros(min(1, e.size)), e[:-1]))
    terms = np.stack((e * e, e * before, before * before, e, np.ones(e.size)))
    found = [np.array(ratio) @ terms for bit, ratio in _QUADRATIC if bit & bits]
    return np.array(found + [test.log_ratio(e) for bit, test in _DENSITIES if bit & bits]).reshape(-1, e.size)
