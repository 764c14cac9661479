import jsonschema
import pytest

from config.loader import load, shipped
from config.schema import json_schema, json_schema_text
from config.yaml_files import parse
from tests.cases import cases

VALIDATOR = jsonschema.Draft202012Validator(json_schema())


def data_of(text):
    return parse(text, "twin.yaml")[0]


def test_the_schema_is_a_json_schema():
    jsonschema.Draft202012Validator.check_schema(json_schema())
    assert json_schema_text().endswith("}\n")


@pytest.mark.parametrize("name", shipped())
def test_every_twin_that_ships_satisfies_it(name):
    assert [error.message for error in VALIDATOR.iter_errors(data_of(load(name).text))] == []


@cases(__file__, "schema_faults.csv")
def test_short_forms_satisfy_it_and_mistakes_are_found_where_they_are(text, places):
    assert [error.json_path for error in VALIDATOR.iter_errors(data_of(text))] == places.split()


def test_every_key_is_described():
    """An editor shows the description under the cursor; a key without one is undocumented."""
    schema = json_schema()

    def described(value):
        section = schema["$defs"].get(value.get("$ref", "").rpartition("/")[2], {})
        return bool(value.get("description") or section.get("description"))

    bare = [
        f"{name}.{key}"
        for name, section in {"twin": schema, **schema["$defs"]}.items()
        for key, value in section.get("properties", {}).items()
        if not described(value)
    ]
    assert bare == []
