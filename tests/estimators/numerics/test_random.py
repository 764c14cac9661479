"""Randomness by place: the published generator, the normal law, independence, and the same bits in any split."""

import numpy as np
import pytest
from scipy import stats

from estimators.numerics.random import _DENSITY, _SCALE, _edge, fill_normals, key_of, mix, unit, word

N = 200_000


def block(seed=1, index=2, stream=3, members=N, k=1):
    out = np.empty((members, k))
    fill_normals(np.uint64(key_of(seed, index, stream)), np.uint64(0), out.size, out.reshape(-1))
    return out


def uniforms(seed, stream):
    return np.array([unit(np.uint64(word(np.uint64(key_of(seed, i, stream)), np.uint64(0)))) for i in range(20_000)])


def test_the_words_are_those_of_the_published_generator():
    # First outputs of SplitMix64 seeded with 1234567, as given with Vigna's reference code and in its ports' tests.
    expected = (6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431)
    assert tuple(int(word(np.uint64(1234567), np.uint64(i))) for i in range(4)) == expected


def test_the_output_function_is_a_bijection_with_avalanche():
    rng = np.random.default_rng(0)
    flips = []
    for z in rng.integers(0, 2**63, 200, dtype=np.uint64):
        for bit in range(0, 64, 7):
            changed = int(mix(z)) ^ int(mix(z ^ np.uint64(1 << bit)))
            flips.append(changed.bit_count())
    # Half of 64 bits change: a mean of 2000 binomials of std 4 is within 5 · 4/√2000.
    assert abs(np.mean(flips) - 32.0) < 5 * 4 / np.sqrt(len(flips))


def test_normals_follow_the_normal_law():
    z = block(members=5 * N).ravel()
    assert stats.kstest(z, "norm").pvalue > 1e-3
    # Moments within 5 standard errors: var(z²) = 2, var(z³) = 15, var(z⁴) = 96.
    for power, mean, variance in ((1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0)):
        assert abs(np.mean(z**power) - mean) < 5 * np.sqrt(variance / z.size), power


def test_the_tail_and_the_wedges_are_drawn_in_their_share():
    z = np.abs(block(members=10 * N).ravel())
    for bound in (0.2, 1.0, 2.5, 3.6541528853610088, 4.0):
        share = 2 * stats.norm.sf(bound)
        assert abs(np.mean(z > bound) - share) < 5 * np.sqrt(share / z.size), bound
    beyond = z[z > 3.6541528853610088]
    law = stats.truncnorm(3.6541528853610088, np.inf)
    assert stats.kstest(beyond, law.cdf).pvalue > 1e-3


def test_the_rare_path_alone_draws_the_tail():
    draws = np.array([_edge(np.uint64(5), np.uint64(i), 0, (1 << 54) - 1) for i in range(3000)])
    law = stats.truncnorm(3.6541528853610088, np.inf)
    # A position at the far end of the base strip is always in the tail.
    assert stats.kstest(draws, law.cdf).pvalue > 1e-3
    left = [_edge(np.uint64(5), np.uint64(i), 0, 1 - (1 << 54)) for i in range(3000)]
    assert np.array_equal(left, -draws)


@pytest.mark.parametrize("layer", [1, 2, 40, 150, 254])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_wedge_keeps_what_lies_under_the_density(layer, sign):
    """A point between the rectangle's edge and the layer's: kept with the part of the layer's height that is below."""
    edges = np.sqrt(-2.0 * np.log(_DENSITY[[layer + 1, layer]]))
    position = sign * int(edges @ [0.5, 0.5] / _SCALE[layer])
    x = abs(position) * _SCALE[layer]
    part = (np.exp(-0.5 * x * x) - _DENSITY[layer]) / (_DENSITY[layer + 1] - _DENSITY[layer])
    n = 4000
    kept = sum(_edge(np.uint64(layer), np.uint64(i), layer, position) == sign * x for i in range(n))
    assert abs(kept - part * n) < 5 * np.sqrt(part * (1 - part) * n)


def test_units_are_the_middles_of_their_cells():
    """Of 2⁵² cells of (0, 1), so that a logarithm of either end is finite."""
    assert unit(np.uint64(0)) == 2.0**-53
    assert unit(np.uint64(2**64 - 1)) == 1.0 - 2.0**-53
    assert unit(np.uint64(2**63)) == 0.5 + 2.0**-53


@pytest.mark.parametrize("other", [{"seed": 2}, {"index": 3}, {"stream": 4}, {"stream": 19}])
def test_blocks_of_other_places_are_independent(other):
    a, b = block().ravel(), block(**other).ravel()
    # A correlation of N independent pairs has the standard error 1/√N.
    for x, y in ((a, b), (a * a, b * b), (a[1:], b[:-1]), (a[:-1], a[1:]), (a[:-64], a[64:])):
        assert abs(np.corrcoef(x, y)[0, 1]) < 5 / np.sqrt(N)


def test_columns_and_members_are_independent():
    z = block(members=N // 4, k=4)
    assert np.max(np.abs(np.corrcoef(z.T) - np.eye(4))) < 5 / np.sqrt(N // 4)
    # Sums over a member are normal with variance k, so their squares have the mean k and the variance 2k².
    assert abs(np.mean(z.sum(axis=1) ** 2) - 4) < 5 * np.sqrt(2 * 16 / len(z))


def test_uniforms_over_events_are_uniform():
    u = uniforms(9, 1)
    assert stats.kstest(u, "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(u[1:], u[:-1])[0, 1]) < 5 / np.sqrt(u.size)
    assert 0 < u.min() and u.max() < 1
    for other in ({"seed": 10}, {"stream": 2}):
        v = uniforms(other.get("seed", 9), other.get("stream", 1))
        assert abs(np.corrcoef(u, v)[0, 1]) < 5 / np.sqrt(u.size)


def test_a_run_of_a_key_is_the_blocks_numbers():
    out = np.full(12, np.nan)
    fill_normals(key_of(1, 2, 3), np.uint64(5), 10, out)
    assert np.array_equal(out[:10], block(members=20).ravel()[5:15]) and np.all(np.isnan(out[10:]))


@pytest.mark.parametrize("cuts", [(1, 2), (64, 999), (500, 501)])
def test_any_split_draws_the_same_bits(cuts):
    whole = block(members=1000, k=3)
    parts = np.empty_like(whole)
    for a, b in zip((0, *cuts), (*cuts, 1000), strict=True):
        fill_normals(np.uint64(key_of(1, 2, 3)), np.uint64(3 * a), 3 * (b - a), parts[a:b].reshape(-1))
    assert np.array_equal(whole, parts)


def test_keys_differ_in_every_argument():
    keys = {int(key_of(s, i, k)) for s in range(8) for i in range(64) for k in range(64)}
    assert len(keys) == 8 * 64 * 64
