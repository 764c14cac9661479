"""Files of the user that hold YAML: read as text, and shown in messages."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from estimators.errors import ConfigError


def shown_path(path: Path) -> str:
    """A path as messages show it: relative to the working directory where it lies inside."""
    try:
        return str(path.absolute().relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(path)


def read_text(path: Path, listing: str) -> str:
    """The text of a YAML file.

    Args:
        path: Where it is.
        listing: The command that says which there are.

    Raises:
        ConfigError: If it is not there, no file, or no text.
    """
    shown_name = shown_path(path)
    try:
        if not path.is_file() and not path.is_dir() and path.exists():
            raise ConfigError(f"{shown_name}: it is a pipe or a device, which may never end; give a file")
        raw = path.read_bytes()
    except FileNotFoundError:
        raise ConfigError(f"{shown_name}: there is no such file; check the path, or see `{listing}`") from None
    except IsADirectoryError:
        raise ConfigError(f"{shown_name}: it is a folder; give the YAML file in it") from None
    except OSError as error:
        raise ConfigError(f"{shown_name}: it cannot be read: {error.strerror}; check its permissions") from None
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if path.suffix.lower() == ".rrd":
            raise ConfigError(f"{shown_name}: it is a recording; `nisus review {shown_name}` opens it") from None
        line = raw.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{shown_name}:{line}: it is not UTF-8 text; is this the YAML file?") from None


@contextmanager
def writing(path: Path, option: str = "") -> Iterator[None]:
    """Report an error while a file is written in one line that names it.

    Args:
        path: The file.
        option: Option of the command line that gave it.

    Raises:
        ConfigError: In place of any OSError; most of those name no file (a full disk).
    """
    try:
        yield
    except OSError as error:
        name = f"{option} {shown_path(path)}".strip()
        raise ConfigError(
            f"{name}: cannot be written: {error.strerror or error}; check free space and permissions"
        ) from None
