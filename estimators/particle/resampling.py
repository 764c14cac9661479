"""Resampling: how many children each particle gets, by four schemes, and the children put in place.

All are unbiased, E[children of i] = N w_i. Systematic and stratified put one point into each of N equal strata of the
cumulated weights (the same place in each, or a place of its own); residual gives ⌊N w_i⌋ and draws the rest;
multinomial draws all. Stratified and residual never vary more than multinomial; systematic is the cheapest and usually
varies least, but can be the worst for contrived orders.

Source: Douc & Cappé (2005), Comparison of resampling schemes for particle filtering, doi:10.1109/ISPA.2005.195385.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from ..numerics.jit import jit
from ..numerics.random import unit, word

SYSTEMATIC, STRATIFIED, RESIDUAL, MULTINOMIAL = range(4)


SCHEME_NAMES = ("systematic", "stratified", "residual", "multinomial")


@jit
def points_below(scheme, key, t):
    """Return how many of the points k + u_k, k = 0 … N-1, lie below t; u_k is one number or a stratum's own."""
    k = np.floor(t)
    place = np.uint64(0) if scheme == SYSTEMATIC else np.uint64(k)
    return k + 1.0 if unit(word(key, place)) < t - k else k


@jit
def strata_children(scheme, key, w, before, after, scale, children):
    """Fill `children` of the members whose weights are `w` by systematic or stratified resampling.

    The members are a run out of N. `before` and `after` are the cumulated weights at its ends in units of points (0 to
    exactly N), the same bits as in the neighbouring runs, and `scale` turns a weight into points. So runs can be done
    in any order, on any number of threads.
    """
    below = points_below(scheme, key, before)
    cumulated = before
    last = w.size - 1
    for i in range(w.size):
        cumulated += w[i] * scale
        upto = points_below(scheme, key, after if i == last else min(cumulated, after))
        children[i] = upto - below
        below = upto


@jit
def _draw_children(key, w, total, draws, children):
    """Add `draws` children, each to member i with probability w_i / total.

    Sorted uniforms from the top: the largest of k is U^(1/k) times the next larger. Source: Bentley & Saxe (1980),
    Generating sorted lists of random numbers, doi:10.1145/355900.355907.
    """
    i = w.size - 1
    edge = total - w[i]
    top = 1.0
    for k in range(draws, 0, -1):
        top *= np.exp(np.log(unit(word(key, np.uint64(k)))) / k)
        target = top * total
        while target < edge and i > 0:
            i -= 1
            edge -= w[i]
        children[i] += 1.0


@jit
def drawn_children(scheme, key, w, total, children):
    """Fill `children` (N,) by residual or multinomial resampling; `w` is overwritten by the residual one."""
    n = w.size
    if scheme == MULTINOMIAL:
        children[:] = 0.0
        _draw_children(key, w, total, n, children)
        return
    given = 0.0
    rest = 0.0
    for i in range(n):
        share = n * (w[i] / total)
        children[i] = np.floor(share)
        given += children[i]
        w[i] = share - children[i]
        rest += w[i]
    # The sum of rounded shares can fall short of a whole number by rounding, never by half.
    draws = int(n - given)
    if draws > 0:
        _draw_children(key, w, rest, draws, children)


@jit
def ancestors_of(children, first, ancestors):
    """Fill `ancestors` int64 with each child's parent, who are the members from `first` on.

    Siblings stand side by side, families in the members' order: so neighbouring members descend from neighbours, and
    the strata of the next systematic or stratified resampling keep dividing the cloud evenly; with children wherever
    there is room these two schemes lose most of their advantage over multinomial resampling.
    """
    n = ancestors.size
    k = 0
    for i in range(children.size):
        count = min(int(children[i]), n - k)
        parent = first + i
        if k + 4 <= n:
            # Four are written always and count if due: a branch on a random number is guessed wrong half the time. What
            # is too many is written over by the next families.
            ancestors[k] = parent
            ancestors[k + 1] = parent
            ancestors[k + 2] = parent
            ancestors[k + 3] = parent
            for c in range(4, count):
                ancestors[k + c] = parent
        else:
            for c in range(count):
                ancestors[k + c] = parent
        k += max(count, 0)


@jit
def take(ancestors, rows, later):
    """Replace each row (N, k) by its ancestor's, in place, where that stands behind it, or else before it.

    See `take_ancestors`.
    """
    n, width = rows.shape
    flat = rows.reshape(n * width)
    for i in range(n):
        k = i if later else n - 1 - i
        parent = ancestors[k]
        if parent > k if later else parent < k:
            for j in range(width):
                flat[k * width + j] = flat[parent * width + j]


@jit
def take_ancestors(ancestors, rows):
    """Replace each row (N, k) by its ancestor's, in place; `ancestors` (N,) never falls.

    Later ancestors are copied from the front, earlier ones from the end: since ancestors never fall, none is
    overwritten before its last child is copied, neither within a pass nor by the other, so that both may run at once.
    """
    take(ancestors, rows, True)
    take(ancestors, rows, False)


@jit(parallel=True)
def _take_on_threads(ancestors, records, lineage):
    for task in prange(4):
        take(ancestors, records if task % 2 == 0 else lineage, task == 0 or task == 3)


@jit
def descend(ancestors, records, lineage, threads):
    """Apply `take_ancestors` to the records (N, k) and the lineage (N, 1), on one thread or several."""
    if threads:
        _take_on_threads(ancestors, records, lineage)
    else:
        take_ancestors(ancestors, records)
        take_ancestors(ancestors, lineage)
