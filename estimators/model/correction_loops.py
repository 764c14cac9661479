"""Learned corrections of one state, as loops for the compiler; the equations are those of correction.py.

`place` says where each feature is, x[place] or u[-1 - place], and `target` which states are corrected. x may be
complex, for derivatives.
"""

from __future__ import annotations

import numpy as np


def process_add(x, u, dt, place, target, data, out):
    """out[target] += dt m."""
    scaled, inverse, weights, _ = data
    for i in range(scaled.shape[0]):
        near = 0.0 * x[0]
        for j in range(place.size):
            z = x[place[j]] if place[j] >= 0 else u[-1 - place[j]] + 0.0 * x[0]
            off = z * inverse[j] - scaled[i, j]
            near += off * off
        near = np.exp(-0.5 * near)
        for c in range(target.size):
            out[target[c]] += dt * near * weights[i, c]


def process_slope(x, u, dt, place, target, data, out):
    """out[target, :] += dt ∂m/∂x."""
    scaled, inverse, weights, _ = data
    for i in range(scaled.shape[0]):
        near = 0.0
        for j in range(place.size):
            z = x[place[j]] if place[j] >= 0 else u[-1 - place[j]]
            near += (z * inverse[j] - scaled[i, j]) ** 2
        near = np.exp(-0.5 * near)
        for j in range(place.size):
            if place[j] >= 0:
                fall = -(x[place[j]] * inverse[j] - scaled[i, j]) * inverse[j] * near * dt
                for c in range(target.size):
                    out[target[c], place[j]] += fall * weights[i, c]


def process_share(x, u, place, data):
    """s."""
    scaled, inverse, _, root = data
    n = scaled.shape[0]
    near = np.empty(n)
    for i in range(n):
        total = 0.0
        for j in range(place.size):
            z = x[place[j]] if place[j] >= 0 else u[-1 - place[j]]
            total += (z * inverse[j] - scaled[i, j]) ** 2
        near[i] = np.exp(-0.5 * total)
    left = 1.0
    for i in range(n):
        part = 0.0
        for j in range(i + 1):
            part += root[i, j] * near[j]
        left -= part * part
    return min(1.0, max(0.0, left))


def _standard(x, u, place, data, z):
    """z = the standardised features; returns D."""
    centre, scale, precision = data[0], data[1], data[2]
    for j in range(place.size):
        value = x[place[j]] if place[j] >= 0 else u[-1 - place[j]] + 0.0 * x[0]
        z[j] = (value - centre[j]) / scale[j]
    square = 0.0 * x[0]
    for i in range(z.size):
        for j in range(z.size):
            square += z[i] * precision[i, j] * z[j]
    return np.sqrt(square)


def _belief(distance, reach):
    """g of a distance D."""
    beyond = distance - reach
    if beyond.real <= 0.0:
        beyond = 0.0 * distance
    return np.exp(-0.5 * beyond * beyond)


def _term(z, pair, whole):
    """One entry of φ, of features whose product with nothing is `whole`."""
    value = whole
    if pair[0] >= 0:
        value = value * z[pair[0]]
    if pair[1] >= 0:
        value = value * z[pair[1]]
    return value


def ridge_add(x, u, dt, place, target, data, out):
    """out[target] += dt m."""
    _, _, _, reach, terms, weights, _ = data
    z = np.empty(place.size, x.dtype)
    g = _belief(_standard(x, u, place, data, z), reach[0])
    for i in range(terms.shape[0]):
        term = _term(z, terms[i], g)
        for c in range(target.size):
            out[target[c]] += dt * term * weights[i, c]


def ridge_slope(x, u, dt, place, target, data, out):
    """out[target, :] += dt ∂m/∂x."""
    _, scale, precision, reach, terms, weights, _ = data
    z = np.empty(place.size)
    distance = _standard(x, u, place, data, z)
    g = _belief(distance, reach[0])
    for j in range(place.size):
        if place[j] < 0:
            continue
        turned = 0.0
        for i in range(place.size):
            turned += precision[j, i] * z[i]
        fading = -max(0.0, distance - reach[0]) * turned / distance if distance > 0.0 else 0.0
        for i in range(terms.shape[0]):
            a, b = terms[i, 0], terms[i, 1]
            slope = fading * _term(z, terms[i], 1.0)
            if a == j:
                slope += z[b] if b >= 0 else 1.0
            if b == j:
                slope += z[a]
            for c in range(target.size):
                out[target[c], place[j]] += dt * g * slope / scale[j] * weights[i, c]


def ridge_share(x, u, place, data):
    """s."""
    _, _, _, reach, terms, _, C = data
    z = np.empty(place.size)
    g = _belief(_standard(x, u, place, data, z), reach[0])
    left = 0.0
    for i in range(terms.shape[0]):
        row = _term(z, terms[i], 1.0)
        for j in range(terms.shape[0]):
            left += row * C[i, j] * _term(z, terms[j], 1.0)
    return 1.0 - g * (1.0 - min(1.0, left))


def net_share(x, u, place, data):
    """s."""
    z = np.empty(place.size)
    return 1.0 - _belief(_standard(x, u, place, data, z), data[3][0])
