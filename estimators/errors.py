"""The errors that Nisus raises, each one line that a user can act on, and names and numbers in such a line."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

LARGEST = 1e50
"""Beyond any physical quantity in any unit; its fourth power, which covariances multiply up to, is still a number."""


class NisusError(Exception):
    """Anything that Nisus refuses: the text names the value, the rule and the remedy."""


class ConfigError(NisusError):
    """A twin's YAML, or a command-line value, that breaks a rule."""


class SourceError(NisusError):
    """A data source that cannot be opened or read."""


class EstimatorError(NisusError):
    """An estimator that does not apply, or an option out of its range."""


class ModelError(NisusError):
    """A model whose declaration or functions disagree."""


class EventError(NisusError):
    """An event that does not fit the log or the model."""


MAX_QUOTED_CHARACTERS = 60
"""Characters of a text from a file that a message shows."""


def printable(text: str) -> str:
    """The text with control characters escaped: bytes of a file must not reach a terminal or a page."""
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


def reason_of(error: BaseException) -> str:
    """Return the message of an error; of one that is not of Nisus, its type too."""
    return str(error) if isinstance(error, NisusError) else f"{type(error).__name__}: {error}"


def quoted(text: str) -> str:
    """A text from a file as a message shows it: shortened, in quotes, with unprintable characters escaped."""
    return repr(text if len(text) <= MAX_QUOTED_CHARACTERS else text[: MAX_QUOTED_CHARACTERS - 3] + "...")


def shown_name(name: str) -> str:
    """A name from a file as a message shows it: as it is, unless it is empty, long or unprintable."""
    return name if 0 < len(name) <= MAX_QUOTED_CHARACTERS and name.isprintable() else quoted(name)


def is_blank(name: str) -> bool:
    """Return whether nothing of a name can be seen, as of white space."""
    return not any(letter.isprintable() and not letter.isspace() for letter in name)


def spaced(unit: str) -> str:
    """Return a unit as it follows a number; nothing for dimensionless quantities."""
    return f" {unit}" if unit and unit != "1" else ""


def digits(value: float, sign: str = "") -> str:
    """Format a number with three digits, with an exponent only where that is shorter: `2,280`, `0.0375`, `1.8e+10`.

    `sign`: "+" shows that of a positive number too. Zero has none.
    """
    value = value or 0.0
    if 1e3 <= abs(value) < 1e6:
        return f"{float(f'{value:.3g}'):{sign},.0f}"
    return f"{value:{sign if value else ''}.3g}"


def nearest(name: str, names: Iterable[str]) -> str:
    """The remedy for a name that is not among `names`: the near ones, or all of them if they are few."""
    names = [str(item) for item in names]
    near = get_close_matches(name, names, n=3, cutoff=0.6)
    lower = name.lower()
    if not near and len(name) > 2:
        near = [item for item in names if lower in item.lower() or (len(item) > 2 and item.lower() in lower)][:3]
    elif not near and name:
        near = [item for item in names if item.lower().startswith(lower)][:3]
    if near:
        *others, last = map(shown_name, near)
        return f"did you mean {', '.join(others)}{' or ' if others else ''}{last}?"
    shown = ", ".join(map(shown_name, names[:24]))
    return f"choose from {shown}{', ...' if len(names) > 24 else ''}" if names else "there are none to choose from"
