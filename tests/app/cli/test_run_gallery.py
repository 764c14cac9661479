"""`nisus run` without a name: the gallery; and what needs a name says so."""

import pytest

from app.cli.main import main


def test_without_a_name_it_is_the_gallery(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["run", "--port", "0", "--no-browser", "--duration", "0.1"]) == 0
    assert "Nisus shows the gallery at" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []  # the folder of recordings is made when there is one


@pytest.mark.parametrize(
    "words",
    [["--headless"], ["--record", "x.rrd"], ["--log", "x.csv"], ["--set", "R.winding=9"], ["--estimator", "ukf"]],
)
def test_what_needs_a_twin_says_so(words, capsys):
    assert main(["run", "--port", "0", "--no-browser", *words]) == 2
    assert (
        capsys.readouterr().err == "nisus: run: the twin is missing; name one (`nisus twins` lists those that ship)\n"
    )
