"""The README's Python runs as it is printed, and its commands exist."""

import re
from pathlib import Path

import numpy as np

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")


def test_python_of_the_readme_runs(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    track = names["track"]
    assert track.mean.shape == (6, 2)
    np.testing.assert_array_equal(track.seconds, [1.0, 2.0, 2.5, 3.0, 4.0, 5.0])
    # The value at 3 s is missing: no NIS there, and the standard deviation grows.
    np.testing.assert_array_equal(np.isnan(track.nis), [False, False, False, True, False, False])
    assert track.std[3, 0] > track.std[2, 0]
    # The reading that brings its variance, 0.5 in place of 9, leaves less than that.
    assert track.std[2, 0] ** 2 < 0.5
    assert "temperature_std" in capsys.readouterr().out


def test_pictures_of_the_readme_are_there():
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README)
    assert len(pictures) == 2
    assert all((Path(__file__).parent.parent / picture).stat().st_size > 10_000 for picture in pictures)
