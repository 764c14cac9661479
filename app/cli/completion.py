"""`nisus completion SHELL`: the script of a shell, which asks `nisus --complete WORDS...` for the next word."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

from config.loader import shipped
from estimators.errors import NisusError

from .arguments import NAMES
from .options import is_positional, options_of

if TYPE_CHECKING:
    from .arguments import CompletionCommand as Arguments

# Without a candidate of ours, each shell completes file names.
SCRIPTS = {
    "bash": """\
_nisus() {
    COMPREPLY=()
    local word
    while IFS= read -r word; do
        COMPREPLY+=("$word")
    done < <(nisus --complete "${COMP_WORDS[@]:1:COMP_CWORD}" 2>/dev/null)
    if [[ ${COMPREPLY[0]} == *= ]]; then compopt -o nospace; fi
}
complete -o bashdefault -o default -F _nisus nisus
""",
    "zsh": """\
#compdef nisus
_nisus() {
    local -a found
    found=("${(@f)$(nisus --complete "${(@)words[2,$CURRENT]}" 2>/dev/null)}")
    if [[ -z ${found[1]} ]]; then
        _files
    elif [[ ${found[1]} == *= ]]; then
        compadd -S '' -- "${found[@]}"
    else
        compadd -- "${found[@]}"
    fi
}
compdef _nisus nisus
""",
    "fish": """\
function __nisus_words
    set -l found (nisus --complete (commandline -opc)[2..-1] (commandline -ct) 2>/dev/null)
    if test (count $found) -gt 0
        string join \\n -- $found
    else
        __fish_complete_path (commandline -ct)
    end
end
complete -c nisus -f -a '(__nisus_words)'
""",
}


def print_script(arguments: Arguments) -> int:
    """Run the command."""
    print(SCRIPTS[arguments.shell], end="")
    return 0


def candidates(words: Sequence[str]) -> list[str]:
    """Return what the last of `words`, typed after `nisus`, can become; nothing where a file is expected."""
    *before, current = [word for word in words if word != "="] or [""]  # bash makes a word of the `=` in --port=0
    if words and words[-1] == "=":
        before, current = [*before, current], ""
    if not before:
        return _starting(current, [*NAMES, "--help", "--version"])
    command = NAMES.get(before[0])
    if command is None:
        return []
    options = {f"--{name.replace('_', '-')}": hint for name, hint in options_of(command).items()}
    option, equals, value = current.partition("=")
    if equals and option in options:
        return [f"{option}={text}" for text in _starting(value, _values(option, options[option], before))]
    if current.startswith("-"):
        return _starting(current, [*options, "--help"])
    named = next((word for word in reversed(before) if word.startswith("--")), "")
    takes_more = named == before[-1] or (get_origin(_plain(options.get(named))) is tuple and named != "--set")
    if named in options and takes_more and _plain(options[named]) is not bool:
        return _starting(current, _values(named, options[named], before))
    return _starting(current, _values_of_positionals(command, before))


def _plain(hint: Any) -> Any:
    """Return a type without its annotations."""
    return hint.__origin__ if hasattr(hint, "__metadata__") else hint


def _values(option: str, hint: Any, before: Sequence[str]) -> Iterable[str]:
    """Return the values of an option that are known by name."""
    if option in ("--estimator", "--estimators"):
        from estimators.registry import ESTIMATORS

        return ESTIMATORS
    if option == "--twin":
        return shipped()
    if option in ("--set", "--tuning"):
        return _values_of_twin(option, before)
    for kind in (_plain(hint), *get_args(_plain(hint))):
        if get_origin(kind) is Literal:
            return map(str, get_args(kind))
    return ()


def _values_of_twin(option: str, before: Sequence[str]) -> Iterable[str]:
    """Return the keys or the tuning versions of the twin that is named among the words."""
    from ..live.tunings.versions import listing
    from ..twin.twin import load_twin

    names = shipped()
    named = next((word for word in before[1:] if word in names or Path(word).suffix in (".yaml", ".yml")), None)
    if named is None:
        return ()
    try:
        twin = load_twin(named)
        if option == "--tuning":
            return [item["name"] for item in listing(twin)]
        return [f"{key}=" for key in ("estimator", *twin.tuning.keys())]
    except NisusError:
        return ()


def _values_of_positionals(command: type, before: Sequence[str]) -> Iterable[str]:
    """Return what a positional argument can be: a choice, or a bundled twin."""
    hints = get_type_hints(command, include_extras=True)
    fields = [field.name for field in dataclasses.fields(command) if is_positional(hints, field)]
    if command is NAMES["tunings"] and any(word in shipped() for word in before[1:]):
        return _values_of_twin("--tuning", before)
    for name in fields:
        if get_origin(_plain(hints[name])) is Literal:
            return map(str, get_args(_plain(hints[name])))
    return shipped() if {"twin", "twins", "name", "what"} & set(fields) and command is not NAMES["new"] else ()


def _starting(text: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(text)]
