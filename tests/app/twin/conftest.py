"""A working directory of its own, where messages show paths as a user sees them."""

import pytest


@pytest.fixture
def inside(tmp_path, monkeypatch):
    """The test runs in a new folder, and finds recordings nowhere else."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("NISUS_DATA", raising=False)
