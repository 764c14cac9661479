"""Files, lines and tokens per package, and the budgets in pyproject.toml that cap lines and tokens."""

from __future__ import annotations

import argparse
import io
import re
import subprocess
import sys
import tokenize
import tomllib
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from pathlib import Path, PurePosixPath

COLUMNS = ("files", "lines", "code", "tokens")
CAPPED = ("lines", "tokens")
LAYOUT = (tokenize.NEWLINE, tokenize.NL, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
# Python 3.12 and later split an f-string into tokens.
FSTRING_START, FSTRING_END = (getattr(tokenize, name, None) for name in ("FSTRING_START", "FSTRING_END"))
JAVASCRIPT = re.compile(r"""(//.*|/\*[\s\S]*?\*/)|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'|\d[\w.]*|[\w$]+|\S""")


def count_python(source: str) -> Counter[str]:
    """Count the lines of a Python file, and its tokens and the lines that have any.

    Tokens are those of `tokenize` without comments, docstrings and layout; an f-string is one token, as in Python 3.11.
    """
    code, statement, tokens, in_fstring = set[int](), list[tokenize.TokenInfo](), 0, 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.NEWLINE:
            if not all(part.type == tokenize.STRING and part.string[0] in "\"'r" for part in statement):
                code.update(*(range(part.start[0], part.end[0] + 1) for part in statement))
                for part in statement:
                    in_fstring -= part.type == FSTRING_END
                    tokens += not in_fstring and part.type != FSTRING_END
                    in_fstring += part.type == FSTRING_START
            statement = []
        elif token.type not in (tokenize.COMMENT, *LAYOUT):
            statement.append(token)
    return Counter(files=1, lines=len(source.splitlines()), code=len(code), tokens=tokens)


def count_javascript(source: str) -> Counter[str]:
    """Count the lines of a JavaScript file, and its tokens and the lines that have any.

    Tokens are, outside comments, strings in single or double quotes, numbers, words, and every other character except
    white space. Template strings and regular expressions are not recognised: their words and characters count.
    """
    code = JAVASCRIPT.sub(lambda part: re.sub(".", " ", part[1]) if part[1] else part[0], source)
    written, tokens = len(re.findall(r"(?m)^.*\S", code)), len(JAVASCRIPT.findall(code))
    return Counter(files=1, lines=len(source.splitlines()), code=written, tokens=tokens)


COUNT = {".py": count_python, ".js": count_javascript}


def git(*words: str) -> str:
    """Return the output of a git command."""
    return subprocess.run(["git", *words], capture_output=True, encoding="utf-8", check=True).stdout


def read(path: str, revision: str | None) -> str:
    """Return the text of a file of a git revision, or of the working tree."""
    return git("show", f"{revision}:{path}") if revision else Path(path).read_text(encoding="utf-8")


def count_file(path: PurePosixPath, revision: str | None) -> Counter[str]:
    """Count the lines and tokens of a file."""
    return COUNT[path.suffix](read(str(path), revision))


def count_all(revision: str | None) -> dict[PurePosixPath, Counter[str]]:
    """Count every file that git tracks in a revision, or in the working tree with new files that are not ignored."""
    listing = ("ls-tree", "-r", "--name-only", revision) if revision else ("ls-files", "-co", "--exclude-standard")
    names = [PurePosixPath(name) for name in git(*listing, "-z").split("\0")]
    paths = [path for path in names if path.suffix in COUNT and (revision or Path(path).is_file())]
    with ProcessPoolExecutor() as pool:  # 6 s of a processor
        return dict(zip(paths, pool.map(count_file, paths, repeat(revision), chunksize=16)))


def print_packages(counted: dict[PurePosixPath, Counter[str]]) -> None:
    """Print the packages, and the sums of the Python of the product, without guides, and of the tests."""
    packages, totals = dict[str, Counter[str]](), {"product": Counter[str](), "tests": Counter[str]()}
    for path, found in counted.items():
        depth = 2 if path.suffix == ".py" else 4
        packages.setdefault("/".join(path.parent.parts[:depth]), Counter()).update(found)
        if path.suffix == ".py" and path.parts[0] != "docs":
            totals["tests" if path.parts[0] == "tests" else "product"].update(found)
    print(f"{'':<28}" + "".join(f"{column:>12}" for column in COLUMNS))
    for name, found in [*sorted(packages.items()), *totals.items()]:
        print(f"{name:<28}" + "".join(f"{found[column]:>12,}" for column in COLUMNS))


def print_budgets(sizes: dict[str, Counter[str]], budgets: dict[str, dict[str, int]]) -> None:
    """Print the lines and tokens of every budget, and how many more there may be."""
    print(f"{'':<28}" + "".join(f"{column:>12}{'budget':>12}{'room':>12}" for column in CAPPED))
    for name, budget in budgets.items():
        rows = [(sizes[name][column], budget[column], budget[column] - sizes[name][column]) for column in CAPPED]
        print(f"{name:<28}" + "".join(f"{figure:>12,}" for row in rows for figure in row))


def main(*words: str) -> None:
    """Print packages and budgets, or check the budgets; `words` are the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.size", description=__doc__)
    parser.add_argument("revision", nargs="?", help="git revision to count instead of the working tree")
    parser.add_argument("--check", action="store_true", help="print only the budgets; fail if one is exceeded")
    args = parser.parse_args(words)
    counted, text = count_all(args.revision), read("pyproject.toml", args.revision)
    budgets = tomllib.loads(text).get("tool", {}).get("nisus", {}).get("size", {})
    sizes, problems = {name: Counter[str]() for name in budgets}, list[str]()
    for path, found in counted.items():
        if names := [name for name in budgets if path.is_relative_to(name)]:
            sizes[max(names, key=len)].update(found)
        else:
            problems.append(f"{path}: in no budget of [tool.nisus.size]; move it to a package that has one")
    problems += [
        f"{name}: {sizes[name][column]:,} {column}, budget {most:,} in pyproject.toml; "
        "delete, or raise the budget only as far as an issue states"
        for name, budget in budgets.items()
        for column, most in budget.items()
        if sizes[name][column] > most
    ]
    if not args.check:
        print_packages(counted)
        print()
    print_budgets(sizes, budgets)
    if args.check and problems:
        sys.exit("\n".join(problems))


if __name__ == "__main__":
    main(*sys.argv[1:])
