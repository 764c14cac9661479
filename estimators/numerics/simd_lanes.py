"""Vector code for symmetric matrices of a few dozen rows, eight side by side: one in each number of a vector (lane).

So small orders fill the vectors too, and no sum goes across a vector. Arrays have the shape (rows, `LANES`); entry
(i, j) of matrices of order n is in row i n + j, and only those with j ≥ i are used.

Source: Golub & Van Loan, Matrix Computations, 4th ed., algorithm 8.3.1 (Householder tridiagonalisation).
"""

from __future__ import annotations

from collections.abc import Callable

from .simd_ir import LANES, Array, Lanes, Value, integer, steps, vector_code

NOTHING = 1e-300
"""Below this a sum of squares may have lost its numbers to underflow: a row that small is zero."""


class LaneRows:
    """Rows of `LANES` numbers of an array."""

    def __init__(self, v: Lanes, array: Array) -> None:
        self.v, self.data = v, array.data

    def _at(self, row: Value) -> Value:
        return self.v.builder.mul(row, integer(LANES))

    def __getitem__(self, row: Value) -> Value:
        return self.v.load(self.data, self._at(row))

    def __setitem__(self, row: Value, value: Value) -> None:
        self.v.store(value, self.data, self._at(row))


def _tiled(v: Lanes, begin: Value, end: Value, height: int, body: Callable[[Value, int], None]) -> None:
    """Write body(i, height) for groups of so many numbers from `begin` on, and body(i, 1) for the rest before `end`."""
    builder = v.builder
    middle = builder.add(begin, builder.and_(builder.sub(end, begin), integer(-height)))
    with steps(builder, begin, middle, height) as i:
        body(i, height)
    with steps(builder, middle, end) as i:
        body(i, 1)


def _sums(v: Lanes, begin: Value, end: Value, terms: Callable[[Value], list[tuple]], count: int) -> list[Value]:
    """Return `count` sums over i of products: terms(i) returns their factors. Four numbers i at a time."""
    builder = v.builder
    parts = [[v.variable() for _ in range(4)] for _ in range(count)]

    def add(i: Value, height: int) -> None:
        for k in range(height):
            for own, (a, b) in zip(parts, terms(builder.add(i, integer(k))), strict=True):
                v.multiply_add_to(own[k], a, b)

    _tiled(v, begin, end, 4, add)
    sums = [[builder.load(one) for one in own] for own in parts]
    return [builder.fadd(builder.fadd(a, b), builder.fadd(c, d)) for a, b, c, d in sums]


@vector_code()
def find_reflection(v, n, k, A, d, e, inverses):
    """Turn row k of A behind the diagonal into v, with I - inverses[k] v vᵀ the reflection that makes it e[k + 1] e₁.

    inverses[k] is 0 for a row that is zero behind its first number.
    """
    builder, zero, one = v.builder, v.constant(0.0), v.constant(1.0)
    A, d, e, inverses = (LaneRows(v, array) for array in (A, d, e, inverses))
    row, first = builder.mul(k, n), builder.add(k, integer(1))
    behind = builder.add(row, first)
    d[k] = A[builder.add(row, k)]
    head = A[behind]
    (tail,) = _sums(v, builder.add(behind, integer(1)), builder.add(row, n), lambda i: [(A[i], A[i])], 1)
    none = builder.fcmp_ordered("<", tail, v.constant(NOTHING))
    length = v.unary("sqrt", v.multiply_add(head, head, tail))
    length = builder.select(builder.fcmp_ordered(">", head, zero), builder.fneg(length), length)
    e[first] = builder.select(none, head, length)
    left = builder.fsub(head, length)
    # vᵀ v / 2 after the change of v₀.
    half = builder.fneg(builder.fmul(length, left))
    inverses[k] = builder.select(none, zero, builder.fdiv(one, half))
    A[behind] = left


@vector_code()
def multiply(v, n, k, A, w):
    """w = A v behind row k, of which v is the part behind the diagonal; A is read on and above its diagonal."""
    builder = v.builder
    A, w = LaneRows(v, A), LaneRows(v, w)
    row, first = builder.mul(k, n), builder.add(k, integer(1))
    with steps(builder, first, n) as i:
        w[i] = v.constant(0.0)

    def tile(i: Value, height: int) -> None:
        rows = [builder.add(i, integer(r)) for r in range(height)]
        bases = [builder.mul(r, n) for r in rows]
        own = [A[builder.add(row, r)] for r in rows]
        sums = [v.variable(w[r]) for r in rows]
        for r in range(height):
            v.multiply_add_to(sums[r], A[builder.add(bases[r], rows[r])], own[r])
            for c in range(r + 1, height):
                entry = A[builder.add(bases[r], rows[c])]
                v.multiply_add_to(sums[r], entry, own[c])
                v.multiply_add_to(sums[c], entry, own[r])
        with steps(builder, builder.add(i, integer(height)), n) as j:
            other, total = A[builder.add(row, j)], w[j]
            for base, mine, one in zip(bases, own, sums, strict=True):
                entry = A[builder.add(base, j)]
                v.multiply_add_to(one, entry, other)
                total = v.multiply_add(entry, mine, total)
            w[j] = total
        for r, one in zip(rows, sums, strict=True):
            w[r] = builder.load(one)

    _tiled(v, first, n, 4, tile)


@vector_code()
def subtract(v, n, k, A, q):
    """A -= v qᵀ + q vᵀ behind row k, on and above the diagonal."""
    builder = v.builder
    A, q = LaneRows(v, A), LaneRows(v, q)
    row = builder.mul(k, n)

    def tile(i: Value, height: int) -> None:
        rows = [builder.add(i, integer(r)) for r in range(height)]
        bases = [builder.mul(r, n) for r in rows]
        left = [(builder.fneg(A[builder.add(row, r)]), builder.fneg(q[r])) for r in rows]

        def change(base: Value, pair: tuple[Value, Value], j: Value, own: Value, other: Value) -> None:
            at = builder.add(base, j)
            A[at] = v.multiply_add(pair[1], own, v.multiply_add(pair[0], other, A[at]))

        for r in range(height):
            for c in range(r, height):
                change(bases[r], left[r], rows[c], A[builder.add(row, rows[c])], q[rows[c]])
        with steps(builder, builder.add(i, integer(height)), n) as j:
            own, other = A[builder.add(row, j)], q[j]
            for base, pair in zip(bases, left, strict=True):
                change(base, pair, j, own, other)

    _tiled(v, builder.add(k, integer(1)), n, 4, tile)


@vector_code()
def reflect(v, n, k, A, inverses, w, b, g):
    """Reflect b and g by I - v vᵀ / half of row k; w ← q = (w - (vᵀ w / (2 half)) v) / half."""
    builder = v.builder
    A, inverses, w, b, g = (LaneRows(v, array) for array in (A, inverses, w, b, g))
    row, first, inverse = builder.mul(k, n), builder.add(k, integer(1)), inverses[k]

    def terms(i: Value) -> list[tuple[Value, Value]]:
        own = A[builder.add(row, i)]
        return [(own, w[i]), (own, b[i]), (own, g[i])]

    along = [builder.fneg(builder.fmul(inverse, total)) for total in _sums(v, first, n, terms, 3)]
    along[0] = builder.fmul(v.constant(0.5), along[0])
    with steps(builder, first, n) as i:
        own = A[builder.add(row, i)]
        w[i] = builder.fmul(inverse, v.multiply_add(along[0], own, w[i]))
        b[i] = v.multiply_add(along[1], own, b[i])
        g[i] = v.multiply_add(along[2], own, g[i])


@vector_code()
def reflect_back(v, n, k, A, inverses, x):
    """x ← (I - v vᵀ / half) x, with v of row k."""
    builder = v.builder
    A, inverses, x = LaneRows(v, A), LaneRows(v, inverses), LaneRows(v, x)
    row, first = builder.mul(k, n), builder.add(k, integer(1))
    (along,) = _sums(v, first, n, lambda i: [(A[builder.add(row, i)], x[i])], 1)
    along = builder.fneg(builder.fmul(inverses[k], along))
    with steps(builder, first, n) as i:
        x[i] = v.multiply_add(along, A[builder.add(row, i)], x[i])


@vector_code()
def lane_dot(v, n, a, b, out):
    """out[0] = Σ a[:n] b[:n]."""
    a, b = LaneRows(v, a), LaneRows(v, b)
    (LaneRows(v, out)[integer(0)],) = _sums(v, integer(0), n, lambda i: [(a[i], b[i])], 1)


@vector_code()
def scale_rows(v, count, own, near, roots, C, d, t, at, G, b, g):
    """Fill matrices and vectors of rows near eight states: G = ρ^½ C ρ^½, b = ρ^½ t, g = ρ^½ d.

    Args:
        v: The instructions.
        count: Number p of rows.
        own: Index of each among the rows near the block (p,).
        near: Index of the latter in C and d.
        roots: ρ^½ (p, LANES).
        C: A matrix of all rows.
        d: A vector of all rows.
        t: Vectors of the rows near the block (rows, columns); of these the columns from `at` on.
        at: The first column.
        G: Gets p² rows.
        b: Gets p rows.
        g: Gets p rows.
    """
    builder = v.builder
    roots, G, b, g = (LaneRows(v, array) for array in (roots, G, b, g))
    width, columns = (builder.extract_value(array.shape, 1) for array in (C, t))

    def index(i: Value) -> tuple[Value, Value]:
        row = builder.load(builder.gep(own.data, [i]))
        return row, builder.load(builder.gep(near.data, [row]))

    with steps(builder, 0, count) as i:
        (row, k), root = index(i), roots[i]
        b[i] = builder.fmul(root, v.load(t.data, builder.add(builder.mul(row, columns), at)))
        g[i] = builder.fmul(root, v.entry(d.data, k))
        entries, base = builder.gep(C.data, [builder.mul(k, width)]), builder.mul(i, count)
        with steps(builder, i, count) as j:
            G[builder.add(base, j)] = builder.fmul(builder.fmul(root, roots[j]), v.entry(entries, index(j)[1]))


@vector_code()
def weighted_gram(v, count, own, tapers, Z, n, G):
    """G = Σ_k ρ_k z_k z_kᵀ over `count` rows z_k = Z[own[k]] (n,), with ρ_k = tapers[k] (LANES,)."""
    builder = v.builder
    tapers, G = LaneRows(v, tapers), LaneRows(v, G)
    width = builder.extract_value(Z.shape, 1)

    def tile(i: Value, j: Value, height: int, across: int) -> None:
        sums = [[v.variable() for _ in range(across)] for _ in range(height)]
        with steps(builder, 0, count) as k:
            row = builder.gep(Z.data, [builder.mul(builder.load(builder.gep(own.data, [k])), width)])
            weight = tapers[k]
            left = [builder.fmul(weight, v.entry(row, builder.add(i, integer(r)))) for r in range(height)]
            for c in range(across):
                right = v.entry(row, builder.add(j, integer(c)))
                for r in range(height):
                    v.multiply_add_to(sums[r][c], left[r], right)
        for r in range(height):
            base = builder.add(builder.mul(builder.add(i, integer(r)), n), j)
            for c in range(across):
                G[builder.add(base, integer(c))] = builder.load(sums[r][c])

    _tiled(v, integer(0), n, 4, lambda i, height: _tiled(v, i, n, 4, lambda j, across: tile(i, j, height, across)))
