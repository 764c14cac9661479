"""Cases of a test in a tab-separated file beside it."""

from pathlib import Path

import pytest


def cases(test_file: str, name: str) -> pytest.MarkDecorator:
    r"""Run a test for every row of a file beside it, whose heading names the arguments; `\n` in a cell ends a line."""
    with Path(test_file).with_name(name).open(encoding="utf-8") as file:
        heading, *rows = ([cell.replace(r"\n", "\n") for cell in line.rstrip("\n").split("\t")] for line in file)
    return pytest.mark.parametrize(heading, [pytest.param(*row, id=f"{name}:{k}") for k, row in enumerate(rows, 2)])
