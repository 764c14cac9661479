"""What an axis spans: the usual, and of the unusual what is near."""

import numpy as np
import pytest

from app.present.export.extent import MARGIN, extent

N = 200


def spanned(low, high):
    return pytest.approx((low - MARGIN * (high - low), high + MARGIN * (high - low)))


def test_all_of_what_is_usual():
    line = np.linspace(2.0, 3.0, N)
    assert extent([line], [(line - 1.0, line + 2.0)], [line + 0.5]) == spanned(1.0, 5.0)


def test_one_wild_reading_and_a_prior_do_not_rule():
    line, wild, lower = np.full(N, 20.0), np.full(N, 20.0), np.full(N, 19.0)
    wild[77], lower[0] = 5e4, -2e3
    assert extent([line], [(lower, line + 1.0)], [wild]) == spanned(19.0, 21.0)


def test_what_is_not_far_is_shown_and_what_settles_is_not():
    line, dots = np.full(N, 20.0), np.full(N, 20.0)
    line[:5], dots[77] = 500.0, 22.5
    assert extent([line], [(line - 1.0, line + 1.0)], [dots]) == spanned(19.0, 501.0)  # its band is as narrow there
    narrow = np.where(np.arange(N) < 5, np.nan, line)
    assert extent([line], [(narrow - 1.0, narrow + 1.0)], [dots]) == spanned(19.0, 22.5)


def test_of_nothing_and_of_one_value():
    nothing = np.full(3, np.nan)
    assert extent([nothing], [(nothing, nothing)], [nothing]) == (0.0, 1.0)
    assert extent([np.full(3, 5.0)], [], []) == pytest.approx((4.995, 5.005))
