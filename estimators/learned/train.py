"""A correction trained on windows, and chosen by blocks of time that it was not trained on.

A filter keeps the error that a wrong rate leaves in a hidden state, so candidates are judged by the drift that they
would leave over a block, not by single windows: neighbours in time are alike, and a correction that knows the one by
the other has learned nothing. With e = r - m of the windows of a block in order, T long each,

    drift = mean over n of (Σᵢ≤ₙ eᵢ T)² / (n T)

which of white noise is the variance that it adds in a second.

Source: Roberts et al. (2017), doi:10.1111/ecog.02881, for blocks where neighbours are alike; Rasmussen & Williams
(2006), 5.4.1, for length scales by marginal likelihood, which scikit-learn finds.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from ..errors import EstimatorError
from ..fit.judge import COVERED, NARROWER, SURE, WORSE, Part, Prediction, gain
from ..model.correction import Correction, GaussianProcess, Net, Ridge
from .windows import Windows

GP, RIDGE, NET = KINDS = ("gp", "ridge", "net")

FEWEST = 8
"""Windows with which anything is trained."""

MOST = 400
"""Windows that a Gaussian process may keep: a step takes as many exponentials, Q half their square in products."""

REACHES = (1.0, 2.0, 4.0)
"""Length scales that are tried, in standard deviations of the features."""

RATIOS = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
"""What is tried of the variance that a window has beside the correction, over the correction's."""

PENALTIES = (0.1, 1.0, 10.0, 100.0, 1000.0)
"""What is tried of a ridge's penalty."""

NEEDS = "it needs scikit-learn: pip install 'nisus[learned]'"


class Candidate(NamedTuple):
    """A way to train, in words, and what does it."""

    words: str
    on: Callable[[Windows], Correction]


class Trained(NamedTuple):
    """A correction, and what it leaves where it was not trained.

    `rest` (M, k) are the rates that were left in each window by a correction trained on the other blocks; `drift` and
    `before` (k,) the variances a second that they add up to, with the correction and without; `words` say which it is.
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
        names: Of the features.
        degree: Of a ridge.
        net: Of kind `net` the function, which is trained already: it is only asked what it leaves.

    Raises:
        EstimatorError: If there are too few windows or too many, a feature does not move, or scikit-learn is absent.
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
    """Rates (M, k) that are left in each window by a correction that was trained on the other blocks."""
    rest = np.empty_like(given.rates)
    for block in np.unique(given.block):
        rows = given.block == block
        rest[rows] = given.rates[rows] - candidate.on(given.of(~rows)).mean(given.features[rows])
    return rest


def drift(given: Windows, rates: np.ndarray) -> np.ndarray:
    """The variance a second (k,) that rates (M, k) of windows add up to; see above."""
    found = []
    for block in np.unique(given.block):
        rows = given.block == block
        lasted = (given.end - given.start)[rows, None]
        found.append(np.cumsum(rates[rows] * lasted, axis=0) ** 2 / np.cumsum(lasted, axis=0))
    return np.asarray(np.mean(np.concatenate(found), axis=0))


def _check(kind: str, given: Windows, names: Sequence[str]) -> None:
    count = len(given.start)
    if count < FEWEST or np.unique(given.block).size < 2:
        raise EstimatorError(
            f"there are {count} windows to learn from; it takes {FEWEST} or more of two blocks: a longer recording, or "
            "shorter windows"
        )
    if kind == GP and count > MOST:
        raise EstimatorError(
            f"there are {count} windows, and a Gaussian process takes {MOST} at most; make them longer"
        )
    for name, values in zip(names, given.features.T, strict=True):
        if not np.ptp(values) > 1e-9 * np.max(np.abs(values)):
            raise EstimatorError(f"{name} is {values[0]:g} in every window, and tells nothing apart; leave it out")


def _candidates(kind: str, given: Windows, degree: int, net: Callable | None) -> Iterator[Candidate]:
    if kind == NET:
        assert net is not None
        found = Net(given.features, net)
        yield Candidate("trained elsewhere", lambda part: found)
    elif kind == RIDGE:
        for penalty in PENALTIES:
            yield Candidate(f"degree {degree}, penalty {penalty:g}", partial(_ridge, penalty, degree))
    else:
        yield Candidate("length scales by marginal likelihood", _likeliest)
        for reach in REACHES:
            for ratio in RATIOS:
                words = f"length scales of {reach:g} deviations, noise ratio {ratio:g}"
                yield Candidate(words, partial(_process, reach, ratio))


def _ridge(penalty: float, degree: int, given: Windows) -> Ridge:
    return Ridge(given.features, given.rates, penalty, degree)


def _process(reach: float, ratio: float, given: Windows) -> GaussianProcess:
    return GaussianProcess(given.features, given.rates, reach * given.features.std(axis=0), ratio)


def _likeliest(given: Windows) -> GaussianProcess:
    """A process with a length scale for each feature, and a ratio, of the greatest marginal likelihood."""
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
    """What the physics and the correction leave over in some windows, (k,) by corrected state.

    `rms` of the rates and the `drift` that they add up to, first of the physics; `known` is the mean share of its
    variance that the correction knows away there.
    """

    n: int
    rms: tuple[np.ndarray, np.ndarray]
    drift: tuple[np.ndarray, np.ndarray]
    known: float


def known(trained: Trained, given: Windows) -> float:
    """The mean share of its variance that a correction knows away in some windows."""
    return 1.0 - float(np.mean(trained.correction.share(given.features)))


def on_windows(given: Windows, rest: np.ndarray, share: float) -> OnWindows:
    """Of windows in which the correction left `rest` (M, k), and knows that share."""
    both = given.rates, rest
    first, second = (np.sqrt(np.mean(rates**2, axis=0)) for rates in both)
    return OnWindows(len(rest), (first, second), (drift(given, both[0]), drift(given, both[1])), share)


def on_held_out(trained: Trained, given: Windows) -> OnWindows:
    """Of windows that took no part in its training."""
    return on_windows(given, given.rates - trained.correction.mean(given.features), known(trained, given))


def against(physics: Sequence[Part], corrected: Part, states: Sequence[str]) -> tuple[str, ...]:
    """What speaks against a correction, on blocks that were held out; nothing if it is better.

    Args:
        physics: The physics alone, first as the twin has it: the correction must be better under any of the tunings.
        corrected: With the correction.
        states: Those that are corrected: judged by their truth where it is known, else by the next reading.
    """
    reasons: list[str] = []
    for one in physics:
        judged = [name for name in states if name in one.states]
        for name in judged:
            old, new = one.states[name], corrected.states[name]
            mean, error = gain(-old.scores, -new.scores)
            if not mean > SURE * error:
                reasons.append(
                    f"the true {name}, held out, is not estimated better: CRPS {new.crps:.3g} {new.unit} after "
                    f"{old.crps:.3g}, by {mean:+.2g} ± {error:.2g}"
                )
            if one is physics[0]:
                reasons += _narrower(f"the true {name}", old, new)
        if not judged:
            mean, error = gain(one.terms, corrected.terms)
            if not mean > SURE * error:
                reasons.append(
                    f"the blocks held out are not predicted better: {mean:+.3g} ± {error:.2g} nats a reading"
                )
        for kind, olds, news in (("sensor", one.sensors, corrected.sensors), ("true", one.states, corrected.states)):
            for name, old in olds.items():
                if kind == "true" and name in judged:
                    continue
                mean, error = gain(old.scores, news[name].scores)
                if mean > WORSE * old.crps and mean > SURE * error:
                    reasons.append(f"{kind} {name} is predicted worse: CRPS {news[name].crps:.3g} after {old.crps:.3g}")
    return tuple(dict.fromkeys(reasons))


def _narrower(what: str, old: Prediction, new: Prediction) -> list[str]:
    if new.coverage < COVERED and new.coverage < old.coverage - NARROWER:
        return [f"{what} leaves its band: {100 * new.coverage:.0f} % inside after {100 * old.coverage:.0f} %"]
    return []
