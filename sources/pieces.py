"""Compiled functions of sources, as pieces of `estimators/pieces.py`; a live source opens once they are compiled."""

from __future__ import annotations

from estimators import pieces as folds
from estimators.numerics.jit import CPUDispatcher
from estimators.pieces import Piece

from .can.signals import extract, extract_signature
from .mapping import emit, emit_signature

FRAMES, VALUES = "frames", "values"
"""In place of a filter's name: bits of frames to values, and values to events."""

KERNELS = {FRAMES: (extract, extract_signature), VALUES: (emit, emit_signature)}


def pieces_of(name: str) -> list[Piece]:
    """Return the pieces that a source or a fold compiles."""
    return [Piece(name, 0)] if name in KERNELS else folds.pieces_of(name)


def needs(name: str) -> tuple[str, ...]:
    """Return the names to compile before something can run: a filter and the loop over events, or a kernel alone."""
    return (name,) if name in KERNELS else (folds.LOOP, name)


def function_of(piece: Piece) -> tuple[CPUDispatcher, tuple[object, ...]]:
    """Return the function of a piece, and the types of its arguments."""
    if piece.of in KERNELS:
        kernel, signature = KERNELS[piece.of]
        return kernel, signature.args
    return folds.function_of(piece)


def make(piece: Piece) -> None:
    """Compile a piece into the cache, if it is not there."""
    folds.compile_into_cache(*function_of(piece))


def is_made(piece: Piece) -> bool:
    """Return whether a piece is in the cache."""
    return folds.is_cached(*function_of(piece))
