"""`nisus twins`: list the bundled twins, or describe one with the scores of each filter."""

from __future__ import annotations

from itertools import takewhile
from typing import TYPE_CHECKING

from config.yaml_files import TWINS, parse, read_text, shipped, shown_path

from ..result import JsonObject

if TYPE_CHECKING:
    from config.loader import Loaded

    from .arguments import TwinsCommand as Arguments


def show_twins(arguments: Arguments) -> int:
    """List the bundled twins, by their titles alone, as a schema takes longer than all else; or describe one."""
    if not (arguments.name or arguments.picture or arguments.json):
        for name in shipped():
            path = TWINS / f"{name}.yaml"
            data, _ = parse(read_text(path, "nisus twins"), shown_path(path))
            print(f"{name:<16} {data.get('title', '')}")
        return 0
    from config.extensions import maker
    from config.loader import load

    from ..result import to_json

    if arguments.picture:
        draw = maker("pictures", "twin", "--picture", "plot")
        drawn = [draw(name) for name in (shipped() if arguments.name is None else [arguments.name])]
        print(to_json(drawn) if arguments.json else "\n".join(drawn))
        return 0
    if arguments.name is not None:
        loaded = load(arguments.name)
        print(to_json(_json(loaded)) if arguments.json else "\n".join(described(loaded)))
    else:
        print(to_json([_head(load(name)) for name in shipped()]))
    return 0


def _head(loaded: Loaded) -> JsonObject:
    from config.model_schema import model_file

    config = loaded.config
    return {
        "name": loaded.path.stem,
        "title": config.title,
        "model": model_file(config.model),
        "estimator": config.estimator.name,
        "source": config.source.type,
        "path": str(loaded.path),
    }


def _json(loaded: Loaded) -> JsonObject:
    """Return head, leading comment of the YAML, and scores: figures as numbers, texts as they are."""
    from ..study.scores import read_scores

    numbers = [{key: _number(cell) for key, cell in line.items()} for line in read_scores(loaded.path)]
    return {**_head(loaded), "description": "\n".join(_prose(loaded)), "scores": numbers}


def _number(cell: str) -> float | str | None:
    """Return a cell of a scores file: a number where it is one, None where it is empty."""
    try:
        return float(cell) if cell else None
    except ValueError:
        return cell


def _prose(loaded: Loaded) -> list[str]:
    """Return the leading comment of the YAML."""
    head = takewhile(lambda line: line.startswith("#"), loaded.text.splitlines())
    return [line.removeprefix("#").removeprefix(" ") for line in head]


def described(loaded: Loaded) -> list[str]:
    """Return title, leading comment of the YAML, and scores as lines of text."""
    from ..study.scores import printed, read_scores

    name = loaded.path.stem
    scores = read_scores(loaded.path)
    table = printed(name, scores) if scores else [f"No scores yet; to write them: nisus compare {name} --write"]
    parts = [[f"{name}: {loaded.config.title}" if loaded.config.title else name], _prose(loaded), table]
    return [line for part in parts if part for line in (*part, "")][:-1]
