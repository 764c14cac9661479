"""Arguments of `nisus learn`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from app.cli.arguments import EstimatorOption, JsonOption, Repeated, TwinOptions


@dataclass(frozen=True)
class LearnCommand(JsonOption, EstimatorOption, TwinOptions):
    """Learn the model error of a twin from recordings, as a correction with its own uncertainty.

    Each recording is divided into blocks of time; on every third the twin is judged with and without the correction.
    Exit status: 0 if the correction is better there, 1 if not; then nothing is written.

    Examples:
      nisus learn motor_bench_hybrid --corrects magnet --features speed,i_d,i_q --kind ridge
    """

    corrects: str
    """States whose rates are corrected, separated by commas: magnet."""
    features: str
    """States and inputs that the correction depends on, separated by commas: speed,i_d,i_q."""
    kind: Literal["gp", "ridge", "net"] = "gp"
    """gp: Gaussian process, needs scikit-learn. ridge: ridge regression. net: the network of --net, which is judged but
    not trained, needs onnxruntime."""
    net: Path | None = None
    """ONNX file for --kind net: features (N, d) to rates (N, k), units of the states per second."""
    degree: Literal[1, 2] = 1
    """Degree of ridge: 2 adds squares and products of the features."""
    window: float = 30.0
    """Seconds over which the model is compared with the true states, or with smoothed states where there are none."""
    log: Repeated = ()
    """Recording to learn from instead of the twin's own, repeatable; FILE,FILE are parts of one recording."""
    duration: float | None = None
    """Read only this many seconds of each recording."""
    blocks: int = 9
    """Number of blocks with equally many measurements; every third is held out (of 3 the last)."""
    keep: Path | None = None
    """Write the correction to this .yaml file; a twin uses it with `correction: FILE`."""
