"""Values written as YAML are read back as they were, and each has its line."""

from hypothesis import given, settings
from hypothesis import strategies as st

from config.yaml_files import as_flow, as_section, parse

NAMES = st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "S", "Zs")), min_size=1, max_size=12)
NUMBERS = st.integers(-(10**12), 10**12) | st.floats(allow_nan=False, allow_infinity=False)
LEAVES = st.none() | st.booleans() | NUMBERS | NAMES
VALUES = st.recursive(LEAVES, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(NAMES, inner, max_size=4))


@settings(deadline=None)
@given(VALUES)
def test_a_value_is_read_back_as_it_was_written(value):
    data, _ = parse(as_flow(value), "a.yaml")
    assert data == value


@settings(deadline=None)
@given(st.dictionaries(NAMES, NUMBERS, min_size=1, max_size=6))
def test_a_section_has_a_line_for_each_entry(items):
    data, places = parse("\n".join(as_section("noise", items)), "a.yaml")
    assert data == {"noise": items}
    assert [places.at(("noise", name)) for name in items] == [f"a.yaml:{k + 2}" for k in range(len(items))]
