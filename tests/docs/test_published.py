"""Published figures are reproduced, and docs/published.md is what `python -m tests.benchmarks.published` writes."""

import pytest

from tests.benchmarks.published import HEADINGS, PAGE, compare, rows

ROWS = rows()
LINES = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.endswith(("yes |", "no |"))]
SHOWN = [line.strip("| ").split(" | ") for line in LINES]


def test_the_page_has_all_rows():
    assert [cells[:4] for cells in SHOWN] == [[row[key] for key in HEADINGS[:4]] for row in ROWS]


@pytest.mark.parametrize(
    "k", [pytest.param(k, marks=pytest.mark.release if row["release"] else ()) for k, row in enumerate(ROWS)]
)
def test_a_published_figure_is_ours(k):
    """Another processor rounds otherwise, and chaos amplifies it: the page is held to the tolerance too."""
    *_, ours, tolerance, _, within = compare(ROWS[k])
    assert within == SHOWN[k][-1] == "yes", (ROWS[k], ours, tolerance)
    assert float(SHOWN[k][4]) == pytest.approx(float(ours), abs=float(tolerance))
