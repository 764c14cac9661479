"""Order of new events: by asset, and of one asset in the order of a log."""

from __future__ import annotations

import numpy as np

from ..numerics.jit import embedded, jit, part


@embedded
def precedes(t, place, value, other_t, other_place, other):
    """Return whether an event comes before another in the order of a log (`sorted_order`)."""
    if t != other_t:
        return t < other_t
    if place != other_place:
        return place < other_place
    for k in range(value.size):
        if value[k] < other[k] or np.isnan(other[k]) and not np.isnan(value[k]):
            return True
        if value[k] > other[k] or np.isnan(value[k]) and not np.isnan(other[k]):
            return False
    return False


@part
def _sort(order, begin, end, spare, t, place, value):
    """Sort order[begin:end] by merging ever longer runs; `spare` is scratch of the same length as `order`."""
    ordered = True
    for k in range(begin + 1, end):
        i, j = order[k], order[k - 1]
        if precedes(t[i], place[i], value[i], t[j], place[j], value[j]):
            ordered = False
            break
    length = 1
    while not ordered and length < end - begin:
        for first in range(begin, end, 2 * length):
            middle, last = min(first + length, end), min(first + 2 * length, end)
            a, b = first, middle
            for k in range(first, last):
                take = a == middle
                if a < middle and b < last:
                    i, j = order[b], order[a]
                    take = precedes(t[i], place[i], value[i], t[j], place[j], value[j])
                if take:
                    spare[k] = order[b]
                    b += 1
                else:
                    spare[k] = order[a]
                    a += 1
        for k in range(begin, end):
            order[k] = spare[k]
        length *= 2


@jit
def arrange(asset, t, place, value, ends, order, spare, visited, starts):
    """Put events in order, and return the number of assets that have any.

    A count by asset takes a tenth of the time of NumPy's sort by all columns.

    Args:
        asset: Positions of the assets of n events, (n,).
        t: Times, ns, (n,).
        place: Places at one time in the order of a log, (n,).
        value: Values, (n, columns).
        ends: Scratch, (assets,).
        order: Filled with the permutation, (n,).
        spare: Scratch, (n,).
        visited: Filled with the assets that have events, ascending, (n,).
        starts: Filled with the first place of each of them in `order`, and n, (n + 1,).
    """
    n = t.size
    ascending = True
    for i in range(1, n):
        if asset[i] < asset[i - 1]:
            ascending = False
            break
    if ascending:
        for i in range(n):
            order[i] = i
    else:
        ends[:] = 0
        for i in range(n):
            ends[asset[i]] += 1
        total = 0
        for a in range(ends.size):
            count = ends[a]
            ends[a] = total
            total += count
        for i in range(n):
            order[ends[asset[i]]] = i
            ends[asset[i]] += 1
    found = 0
    for k in range(n):
        if k == 0 or asset[order[k]] != asset[order[k - 1]]:
            visited[found], starts[found] = asset[order[k]], k
            found += 1
    starts[found] = n
    for v in range(found):
        _sort(order, starts[v], starts[v + 1], spare, t, place, value)
    return found
