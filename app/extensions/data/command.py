"""`nisus data`: the recordings of the bundled twins, and their download."""

from __future__ import annotations

from app.cli.prepare import attend
from app.render.text import to_text
from app.result import Topic, to_json
from app.twin.sources.kind import recordings_folder
from config.yaml_files import shown_path
from estimators.errors import ConfigError

from .arguments import DataCommand
from .sets import find, recordings, size_text


def data(arguments: DataCommand) -> int:
    """List the recordings, or get one of them."""
    found = [*recordings().values()]
    if arguments.action == "get":
        from .download import get  # here, as its libraries take long to load

        if arguments.name is None:
            raise ConfigError("get: name a recording or a twin; nisus data lists them")
        found = [recording := find(arguments.name)]
        given = [path.expanduser() for path in arguments.file]
        origin = given[0] if given else recording.as_json()["host"]
        doing = f"{recording.name} from {origin}, {recording.licence}"
        attend(None, lambda: get(recording, given), doing, text=recording.progress)
    elif arguments.name is not None or arguments.file:
        raise ConfigError(f"list {arguments.name or '--file'}: only get takes a name and files: nisus data get NAME")
    if arguments.json:
        print(to_json([recording.as_json() for recording in found]))
    elif arguments.action == "get":
        print(f"{found[0].name} is in {shown_path(found[0].folder)}; nisus run {found[0].twins[0]} reads it")
    else:
        rows = []
        for one in found:
            here = "no" if one.lacking else "yes"
            rows.append((one.name, ", ".join(one.twins), size_text(one.bytes), here, one.licence, one.source))
        titles = ("recording", "twins", "size", "here", "licence", "source")
        topics = [Topic(f"Recordings in {shown_path(recordings_folder())}", columns=titles, rows=tuple(rows))]
        by_hand = tuple(f"{one.name}: {one.by_hand}" for one in found if one.by_hand and one.lacking)
        print(to_text([*topics, Topic("Downloaded by hand", by_hand)] if by_hand else topics))
    return 0
