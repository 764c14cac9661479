import jsonschema
import pytest

from config.loader import load, shipped
from config.schema import json_schema, json_schema_text
from config.yaml_files import parse

VALIDATOR = jsonschema.Draft202012Validator(json_schema())


def data_of(text):
    return parse(text, "twin.yaml")[0]


def test_the_schema_is_a_json_schema():
    jsonschema.Draft202012Validator.check_schema(json_schema())
    assert json_schema_text().endswith("}\n")


@pytest.mark.parametrize("name", shipped())
def test_every_twin_that_ships_satisfies_it(name):
    assert [error.message for error in VALIDATOR.iter_errors(data_of(load(name).text))] == []


@pytest.mark.parametrize(
    "text",
    [
        "model: a\nsource: {type: simulator}\nestimator: {name: kf, options: {a: 1}}",
        "model: a\nsource: {type: simulator, inputs: {i: 3, j: [1, {sine: {amplitude: 1, period: 2}}]}}",
        "model: a\nsource: {type: can, interface: virtual, channel: 1, dbc: [a.dbc, {file: b.dbc}]}",
        "model: a\nsource: {type: can, interface: virtual, channel: x, dbc: {file: b.dbc, channel: 1}}",
        "model: a\nsource: {type: table, files: a.csv, time: {column: t}, truth: {s: {columns: [a], where: {q: 1}}}}",
        "model: a\nsource: {type: simulator}\nsensors: {s: {std: [1, 2]}}\nview: {pairs: [[a, b]]}",
    ],
)
def test_short_forms_satisfy_it(text):
    assert [error.message for error in VALIDATOR.iter_errors(data_of(text))] == []


@pytest.mark.parametrize(
    "text",
    [
        "source: {type: simulator}",
        "model: a\nsource: {type: simulator}\ngates: 0.9",
        "model: a\nsource: {type: simulator}\ngate: 1.5",
        "model: a\nsource: {type: simulator}\nprior: {s: {std: -1}}",
        "model: a\nsource: {type: simulator, dbc: a.dbc}",
    ],
)
def test_mistakes_do_not(text):
    assert list(VALIDATOR.iter_errors(data_of(text)))


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
