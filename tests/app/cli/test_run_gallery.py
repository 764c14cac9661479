"""`nisus run` without a name: the gallery; and what needs a name says so."""


def test_without_a_name_it_is_the_gallery(nisus, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "Nisus shows the gallery at" in nisus("run", "--port", "0", "--no-browser", "--duration", "0.1").out
    assert list(tmp_path.iterdir()) == []  # the folder of recordings is made when there is one
