"""The README's Python runs as it is printed, and its commands exist."""

import re

import numpy as np

from tests import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")


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


def test_the_notice_names_every_picture_of_a_recording():
    """A twin of a recording gives its files; its pictures bear its name."""
    config = ROOT / "config"
    recorded = [
        path.stem for path in config.glob("twins/*.yaml") if re.search(r"^ +files: ", path.read_text(), re.MULTILINE)
    ]
    pictures = [path for folder in ("cards", "pictures") for path in (config / folder).iterdir()]
    named = re.findall(r"`([^`]+)`", (ROOT / "NOTICE.md").read_text(encoding="utf-8"))
    made = {str(path.relative_to(ROOT)) for path in pictures if path.stem in recorded}
    assert len(made) > 8 and made - set(named) == set()


def test_pictures_of_the_readme_are_there():
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README)
    assert len(pictures) == 2
    assert all((ROOT / picture).stat().st_size > 10_000 for picture in pictures)
