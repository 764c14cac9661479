"""The README's Python runs as it is printed, and its commands exist."""

import re
from pathlib import Path

import numpy as np

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")


def test_python_of_the_readme_runs():
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    track = names["track"]
    assert track.mean.shape == (5, 2)
    # The third value is missing: no NIS there, and the standard deviation grows.
    np.testing.assert_array_equal(np.isnan(track.nis), [False, False, True, False, False])
    assert track.std[2, 0] > track.std[1, 0]


def test_pictures_of_the_readme_are_there():
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README)
    assert len(pictures) >= 4
    assert all((Path(__file__).parent.parent / picture).stat().st_size > 10_000 for picture in pictures)
