"""The code of a fold as pieces that several processes can compile at once into the cache on disk."""

from __future__ import annotations

from typing import NamedTuple

from .estimator import describe_signature, predict_signature, start_signature, update_signature
from .fold_kernel import (
    begin,
    begin_signature,
    judge,
    judge_signature,
    run,
    run_and_judge,
    run_and_judge_signature,
    run_signature,
    screen_reading,
    screen_signature,
)
from .numerics.jit import CPUDispatcher, threaded
from .registry import ESTIMATORS
from .smoothing.moments_back import PIECES

LOOP = "loop"
"""In place of a filter's name: the loop over events, common to all filters."""

SMOOTHER = "smoother"
"""In place of a filter's name: the smoother, common to all filters."""


class Piece(NamedTuple):
    """A separately compiled function of the loop, the smoother or a filter: name, and place in that.

    `after` lists the places of functions that it contains; if they are in the cache it takes a tenth of the time.
    """

    of: str
    place: int
    after: tuple[int, ...] = ()


def pieces_of(name: str) -> list[Piece]:
    """Return the pieces of a filter, of the `LOOP` or the `SMOOTHER`, the slowest first."""
    if name == SMOOTHER:
        return [Piece(SMOOTHER, place) for place in range(len(PIECES))]
    if name == LOOP:
        return [Piece(LOOP, 0), Piece(LOOP, 1), Piece(LOOP, 2, (0, 1)), Piece(LOOP, 3)]
    return [Piece(name, place) for place in range(2 if ESTIMATORS[name].interpreted else 4)]


def function_of(piece: Piece) -> tuple[CPUDispatcher, tuple[object, ...]]:
    """Return the function of a piece, and the types of its arguments."""
    if piece.of == SMOOTHER:
        return PIECES[piece.place]
    if piece.of == LOOP:
        return (
            (judge.linked, judge_signature.args),
            (run, run_signature.args),
            (run_and_judge, run_and_judge_signature.args),
            (begin, begin_signature.args),
        )[piece.place]
    if ESTIMATORS[piece.of].interpreted:
        return ((judge, judge_signature.args), (screen_reading, screen_signature.args))[piece.place]
    start, predict, update, describe = ESTIMATORS[piece.of].functions
    return (
        (update, update_signature.args),
        (predict, predict_signature.args),
        (start, start_signature.args),
        (describe, describe_signature.args),
    )[piece.place]


def compile_into_cache(function: CPUDispatcher, types: tuple[object, ...]) -> None:
    """Compile a function for these arguments, if it is not in the cache."""
    # Code from the cache may start threads.
    threaded()
    function.compile(types)


def is_cached(function: CPUDispatcher, types: tuple[object, ...]) -> bool:
    """Return whether a function is in the cache, which takes a tenth of a millisecond."""
    cache = function._cache
    key = cache._index_key(types, function.targetctx.codegen())
    return types in function.overloads or key in cache._cache_file
