"""`nisus export TWIN --c`: write the filter of a twin as C99 for a controller."""

from __future__ import annotations

from app.cli.prepare import attend, prepared
from app.result import to_json
from app.twin.log_reader import read_log
from estimators.errors import ConfigError

from .arguments import ExportCommand as Arguments
from .filter import export_c


def export_filter(arguments: Arguments) -> int:
    """Write the twin's filter as C99 code."""
    if not arguments.c:
        raise ConfigError("nisus export: name a language; --c writes C99")
    if arguments.events < 1:
        raise ConfigError(f"--events {arguments.events}: must be positive")
    twin = prepared(arguments)
    log, _ = read_log(twin, arguments.duration)
    found = attend(
        twin.model,
        lambda: export_c(twin.name, twin.estimator, twin.model, twin.tuning, log, arguments.events),
        "writing C",
    )
    try:
        arguments.out.mkdir(parents=True, exist_ok=True)
        for name, text in found.files.items():
            (arguments.out / name).write_text(text)
    except OSError as error:
        raise ConfigError(f"--out {arguments.out}: {error.strerror or error}; name a folder to write to") from None
    paths = [arguments.out / name for name in found.files]
    if arguments.json:
        figures = {name: getattr(found, name) for name in FIGURES}
        print(to_json({"twin": twin.name, "estimator": twin.estimator, "files": [str(p) for p in paths], **figures}))
        return 0
    source, test = paths[1], paths[2]
    print("\n".join(str(path) for path in paths))
    print(
        f"{twin.estimator}, {twin.model.nx} states: {found.state_bytes:,} bytes of memory in single precision, twice "
        f"that in double; about {found.code_bytes:,} bytes of code; on a Cortex-M4F about {found.predict_cycles:,} "
        f"cycles a step and {found.update_cycles:,} an update (estimates from the number of operations)"
    )
    print(f"{found.events:,} events in the test{f'; it ends early: {found.ends}' if found.ends else ''}")
    print(f"cc -std=c99 -O2 {source} {test} -lm -o {source.stem}_test && ./{source.stem}_test {paths[3]}")
    return 0


FIGURES = ("state_bytes", "code_bytes", "predict_cycles", "update_cycles", "events", "ends")
"""Figures of the JSON output."""
