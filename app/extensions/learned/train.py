"""Train a correction on windows, choose it by cross-validation over blocks of time, and judge it on held-out blocks.

A filter accumulates the error of a wrong rate in a hidden state, and neighbouring windows are alike. So candidates are
judged by the remaining drift over a block. With e = r - m of the windows of a block in order, T long each,

    drift = mean over n of (Σᵢ≤ₙ eᵢ T)² / (n T)

which for white noise is the variance that it adds per second.

Source: Roberts et al. (2017), doi:10.1111/ecog.02881, for blocks where neighbours are alike; Rasmussen & Williams
(2006), 5.4.1, for length scales by marginal likelihood, which scikit-learn finds.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from estimators.errors import EstimatorError
from estimators.fit.judge import MIN_SIGMAS, PartScore, gain, narrower, worse
from estimators.model.correction import Correction, GaussianProcess, Net, Ridge

from .windows import Windows

GP, RIDGE, NET = KINDS = ("gp", "ridge", "net")


MIN_WINDOWS = 8  # Fewest windows to train on


MAX_WINDOWS = 400
"""Most windows of a Gaussian process: a step takes as many exponentials, Q half their square in products."""


REACHES = (1.0, 2.0, 4.0)  # Length scales to try, in standard deviations of the features
RATIOS = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)  # Ratios to try of the variance of a window to that of the correction
PENALTIES = (0.1, 1.0, 10.0, 100.0, 1000.0)  # Penalties of a ridge to try


NEEDS = "it needs scikit-learn: pip install 'nisus[learned]'"


class Candidate(NamedTuple):
    """A description of a correction, and the function that trains it."""

    words: str
    on: Callable[[Windows], Correction]


class Trained(NamedTuple):
    """A correction, and its errors in cross-validation.

    `rest` (M, k) are the rates left in each window by a correction trained on the other blocks; `drift` and `before`
    (k,) the variances per second that they add up to, with the correction and without; `words` describe the choice.
    """

    correction: Correction
    rest: np.ndarray
    drift: np.ndarray
    before: np.ndarray
    words: str


def train(
    kind: str, given: Windows, *, names: Sequence[str], degree: int = 1, net: Callable | None = None
) -> Trained:  # fmt: skip
    """Train a correction on windows of two blocks or more.

    Args:
        kind: One of `KINDS`.
        given: The windows.
        names: Names of the features.
        degree: Degree of a ridge.
        net: For kind `net` the function, already trained: only its errors are computed.

    Raises:
        EstimatorError: If there are too few windows or too many, a feature is constant, or scikit-learn is absent.
    """
    _check(kind, given, names)
    scale = np.sqrt(np.mean(given.rates**2, axis=0))
    best: tuple[float, Candidate, np.ndarray] | None = None
    for candidate in _candidates(kind, given, degree, net):
        rest = left(candidate, given)
        lost = float(np.sum(drift(given, rest / scale)))
        if best is None or lost < best[0]:
            best = lost, candidate, rest
    assert best is not None
    _, candidate, rest = best
    return Trained(candidate.on(given), rest, drift(given, rest), drift(given, given.rates), candidate.words)


def left(candidate: Candidate, given: Windows) -> np.ndarray:
    """Return the rates (M, k) left in each window by a correction trained on the other blocks."""
    rest = np.empty_like(given.rates)
    for block in np.unique(given.block):
        rows = given.block == block
        rest[rows] = given.rates[rows] - candidate.on(given.of(~rows)).mean(given.features[rows])
    return rest


def drift(given: Windows, rates: np.ndarray) -> np.ndarray:
    """Return the variance per second (k,) that rates (M, k) of windows add up to; see the module's equation."""
    found = []
    for block in np.unique(given.block):
        rows = given.block == block
        lasted = (given.end - given.start)[rows, None]
        found.append(np.cumsum(rates[rows] * lasted, axis=0) ** 2 / np.cumsum(lasted, axis=0))
    return np.asarray(np.mean(np.concatenate(found), axis=0))


def _check(kind: str, given: Windows, names: Sequence[str]) -> None:
    """Reject windows from which a correction cannot be trained."""
    count = len(given.start)
    if count < MIN_WINDOWS or np.unique(given.block).size < 2:
        raise EstimatorError(
            f"there are {count} windows to learn from; it takes {MIN_WINDOWS} or more of two blocks: use a longer "
            "recording, or shorter windows"
        )
    if kind == GP and count > MAX_WINDOWS:
        raise EstimatorError(
            f"there are {count} windows, and a Gaussian process takes {MAX_WINDOWS} at most; make them longer"
        )
    for name, values in zip(names, given.features.T, strict=True):
        if not np.ptp(values) > 1e-9 * np.max(np.abs(values)):
            raise EstimatorError(f"{name} is {values[0]:g} in every window, and explains nothing; leave it out")


def _candidates(kind: str, given: Windows, degree: int, net: Callable | None) -> Iterator[Candidate]:
    if kind == NET:
        assert net is not None
        found = Net(given.features, net)
        yield Candidate("trained elsewhere", lambda part: found)
    elif kind == RIDGE:
        for penalty in PENALTIES:
            ridge = lambda part, penalty=penalty: Ridge(part.features, part.rates, penalty, degree)  # noqa: E731
            yield Candidate(f"degree {degree}, penalty {penalty:g}", ridge)
    else:
        yield Candidate("length scales by marginal likelihood", _likeliest)
        for reach in REACHES:
            for ratio in RATIOS:
                words = f"length scales of {reach:g} deviations, noise ratio {ratio:g}"
                process = lambda part, reach=reach, ratio=ratio: GaussianProcess(  # noqa: E731
                    part.features, part.rates, reach * part.features.std(axis=0), ratio
                )
                yield Candidate(words, process)


def _likeliest(given: Windows) -> GaussianProcess:
    """Return the process with a length scale per feature and a ratio of the greatest marginal likelihood."""
    try:
        from sklearn.gaussian_process import GaussianProcessRegressor, kernels
    except ImportError:
        raise EstimatorError(f"a Gaussian process is trained here; {NEEDS}") from None
    deviation = given.features.std(axis=0)
    scale = np.sqrt(np.mean(given.rates**2, axis=0))
    shape = kernels.ConstantKernel(1.0, (1e-3, 1e3)) * kernels.RBF(np.full(deviation.size, 2.0), (0.5, 100.0))
    found = GaussianProcessRegressor(shape + kernels.WhiteKernel(1.0, (1e-3, 1e3)), alpha=0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # A length at its bound is one that does not matter, or matters most.
        kernel = found.fit(given.features / deviation, given.rates / scale).kernel_
    ratio = kernel.k2.noise_level / kernel.k1.k1.constant_value
    return GaussianProcess(given.features, given.rates, kernel.k1.k2.length_scale * deviation, float(ratio))


class OnWindows(NamedTuple):
    """Errors of the physics and of the correction in some windows, (k,) by corrected state.

    `rms` of the rates and their `drift`, first of the physics; `known` is the mean share of the correction's prior
    variance that its training data explain there.
    """

    n: int
    rms: tuple[np.ndarray, np.ndarray]
    drift: tuple[np.ndarray, np.ndarray]
    known: float


def on_windows(trained: Trained, given: Windows, rest: np.ndarray | None = None) -> OnWindows:
    """Return the errors in windows where the correction left `rest` (M, k); None if they took no part in training."""
    rest = given.rates - trained.correction.mean(given.features) if rest is None else rest
    first, second = (np.sqrt(np.mean(rates**2, axis=0)) for rates in (given.rates, rest))
    share = 1.0 - float(np.mean(trained.correction.share(given.features)))
    return OnWindows(len(rest), (first, second), (drift(given, given.rates), drift(given, rest)), share)


def against(physics: Sequence[PartScore], corrected: PartScore, states: Sequence[str]) -> tuple[str, ...]:
    """Return the reasons against a correction on held-out blocks; empty if it is better.

    It must beat all scores of the physics alone, first of which are those with the twin's tuning. Corrected states are
    judged by their truth where it is known, otherwise by the next measurement.
    """
    reasons: list[str] = []
    for one in physics:
        judged = [name for name in states if name in one.states]
        for name in judged:
            old, new = one.states[name], corrected.states[name]
            mean, error = gain(-old.scores, -new.scores)
            if not mean > MIN_SIGMAS * error:
                reasons.append(
                    f"no better estimate of the held-out true {name}: CRPS {new.crps:.3g} {new.unit} after "
                    f"{old.crps:.3g}, by {mean:+.2g} ± {error:.2g}"
                )
            if one is physics[0]:
                reasons += narrower(f"the true {name}", old, new)
        if not judged:
            mean, error = gain(one.terms, corrected.terms)
            if not mean > MIN_SIGMAS * error:
                reasons.append(f"no better prediction of the held-out blocks: {mean:+.3g} ± {error:.2g} nats a reading")
        for name, old in one.sensors.items():
            reasons += worse(f"sensor {name}", old, corrected.sensors[name])
        for name, old in one.states.items():
            if name not in judged:
                reasons += worse(f"true {name}", old, corrected.states[name])
    return tuple(dict.fromkeys(reasons))
