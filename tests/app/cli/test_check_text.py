"""Tables as text: what is too wide for a line is a paragraph a row, in which a value keeps the name of its column."""

from app.cli.check_text import WIDTH, as_text
from app.present.export.parts import Part


def test_a_value_in_a_paragraph_has_the_head_of_its_column():
    note = "why it was kept " * 12
    head = ("version", "saved", "filter", "NIS", "note")
    narrow = as_text([Part("Versions", (), head, (("a", "today", "kf", "0.95", "short"),))])
    assert narrow[1].split() == list(head) and narrow[2].split() == ["a", "today", "kf", "0.95", "short"]
    wide = as_text([Part("Versions", (), head, (("a", "today", "kf", "0.95", note), ("b", "-", "ekf", "-", note)))])
    assert wide[1:3] == ["  a today", "      filter kf, NIS 0.95"]
    assert "      filter ekf" in wide and max(map(len, wide)) <= WIDTH
    assert " ".join(" ".join(wide).split()).count("why it was kept") == 24
