"""Random numbers as a function of their place: (seed, event, stream, member), so nothing depends on order or threads.

A key is hashed from (seed, index, stream); the numbers of a key are the sequence of SplitMix64 that starts there, of
which any element is had at once: word i is mix(key + (i + 1) γ). One word makes one normal by a ziggurat of 256 layers
in 98.9 % of cases; the others draw from a second sequence that belongs to that normal alone.

Streams tell apart what one prediction or update draws for different purposes.

Sources: Steele, Lea & Flood (2014), Fast splittable pseudorandom number generators, doi:10.1145/2660193.2660195
(SplitMix64, with the constants of Vigna's reference code); Marsaglia & Tsang (2000), The ziggurat method for
generating random variables, doi:10.18637/jss.v005.i08; Marsaglia (1964) for the tail. Unlike theirs, layer and
position come from bits of their own: Doornik (2005), An improved ziggurat method.
"""

from __future__ import annotations

import math

import numpy as np

from .jit import jit

ONE = np.uint64(1)

GAMMA = np.uint64(0x9E3779B97F4A7C15)
"""The golden ratio in 64 bits, odd: SplitMix64's step."""

_M1, _M2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S12 = (np.uint64(s) for s in (30, 27, 31, 12))
_LAYER = np.uint64(0xFF)
_OTHER = np.uint64(0xD1B54A32D192ED03)
_TO_UNIT = 2.0**-52

_R = 3.6541528853610088
"""Start of the tail, for 256 layers of equal area (Marsaglia & Tsang, section 3)."""


def _ziggurat() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scale of each layer for a position of ±2⁵⁴, the position below which it is inside, and the density at its edges.

    Layer 0 is the base strip with the tail, layers 1 to 255 are rectangles of the same area; edge i is x_i, with
    x_1 = r and x_256 = 0.
    """
    x = np.zeros(257)
    tail = np.sqrt(np.pi / 2) * math.erfc(_R / math.sqrt(2))
    area = _R * np.exp(-0.5 * _R * _R) + tail
    x[0], x[1] = area / np.exp(-0.5 * _R * _R), _R
    for i in range(1, 255):
        x[i + 1] = np.sqrt(-2.0 * np.log(area / x[i] + np.exp(-0.5 * x[i] * x[i])))
    scale = x[:256] / 2.0**54
    inside = np.floor(x[1:] / x[:256] * 2.0**54).astype(np.int64)
    return scale, inside, np.exp(-0.5 * x * x)


_SCALE, _INSIDE, _DENSITY = _ziggurat()


@jit
def mix(z):
    """SplitMix64's output function, a bijection of 64 bits."""
    z = (z ^ (z >> _S30)) * _M1
    z = (z ^ (z >> _S27)) * _M2
    return z ^ (z >> _S31)


@jit
def word(key, i):
    """Number i ≥ 0 of the SplitMix64 sequence that is seeded with `key` (both uint64)."""
    return mix(key + (i + ONE) * GAMMA)


@jit
def key_of(seed, index, stream):
    """Return the start of the sequence of (seed, event index, stream)."""
    key = mix(np.uint64(seed) + GAMMA)
    key = mix((key ^ np.uint64(index)) + GAMMA)
    return mix((key ^ np.uint64(stream)) + GAMMA)


@jit
def unit(bits):
    """64 random bits as a number strictly between 0 and 1."""
    return (np.float64(bits >> _S12) + 0.5) * _TO_UNIT


@jit
def _edge(key, i, layer, position):
    """The normal of place i whose first word fell outside its layer's rectangle: wedge, tail, or another try."""
    own = word(key ^ _OTHER, i)
    n = np.uint64(0)
    while True:
        x = position * _SCALE[layer]
        if layer == 0:
            # The tail beyond r; the sign is the position's.
            while True:
                a = -np.log(unit(word(own, n))) / _R
                b = -np.log(unit(word(own, n + ONE)))
                n += np.uint64(2)
                if 2.0 * b > a * a:
                    return _R + a if position >= 0 else -(_R + a)
        height = _DENSITY[layer] + unit(word(own, n)) * (_DENSITY[layer + 1] - _DENSITY[layer])
        if height < np.exp(-0.5 * x * x):
            return x
        bits = word(own, n + ONE)
        n += np.uint64(2)
        layer = np.int64(bits & _LAYER)
        position = np.int64(bits) >> 9
        if abs(position) < _INSIDE[layer]:
            return position * _SCALE[layer]


@jit
def normal(key, i):
    """Normal number i of a key, N(0, 1)."""
    bits = word(key, i)
    layer = np.int64(bits & _LAYER)
    position = np.int64(bits) >> 9
    if abs(position) < _INSIDE[layer]:
        return position * _SCALE[layer]
    return _edge(key, i, layer, position)


@jit
def fill_normals(key, first, n, out):
    """Fill out (n or more,) with the normals `first` and following of a key."""
    for i in range(n):
        out[i] = normal(key, first + np.uint64(i))
