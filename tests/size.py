"""`python -m tests.size [REVISION]`: files and lines per package, of the working tree or of a git revision."""

from __future__ import annotations

import ast
import io
import subprocess
import sys
import tokenize
from collections import Counter
from pathlib import PurePosixPath

COLUMNS = ("files", "lines", "code", "imports", "docstrings", "comments", "blank")


def count(source: str) -> Counter[str]:
    """Count the lines of a Python file by kind; each line counts once, in the order of `kinds` below."""
    tree = ast.parse(source)
    imports, docstrings = set[int](), set[int]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            imports |= {*range(node.lineno, (node.end_lineno or node.lineno) + 1)}
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            docstrings |= {*range(node.lineno, (node.end_lineno or node.lineno) + 1)}
    tokens = list(tokenize.generate_tokens(io.StringIO(source).readline))
    comments = {token.start[0] for token in tokens if token.type == tokenize.COMMENT}
    ignored = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    code = {line for token in tokens if token.type not in ignored for line in range(token.start[0], token.end[0] + 1)}
    lines = len(source.splitlines())
    kinds = {"imports": imports, "docstrings": docstrings, "code": code, "comments": comments}
    found, seen = Counter(files=1, lines=lines), set[int]()
    for kind, numbers in kinds.items():
        found[kind] = len(numbers - seen)
        seen |= numbers
    found["blank"] = lines - len(seen)
    return found


def sources(revision: str | None) -> dict[PurePosixPath, str]:
    """Return the text of every Python file that git tracks, by its path."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], capture_output=True, text=True, check=True).stdout

    if revision is None:
        paths = [path for path in git("ls-files", "*.py").splitlines() if not path.startswith("docs/")]
        return {PurePosixPath(path): open(path, encoding="utf-8").read() for path in paths}
    paths = [path for path in git("ls-tree", "-r", "--name-only", revision).splitlines() if path.endswith(".py")]
    return {PurePosixPath(path): git("show", f"{revision}:{path}") for path in paths if not path.startswith("docs/")}


def main(revision: str | None = None) -> None:
    """Print the table: packages, the product without tests, and tests."""
    packages: dict[str, Counter[str]] = {}
    for path, text in sources(revision).items():
        parts = path.parts[:-1]
        counted = count(text)
        for name in {"/".join(parts[:2]), "tests" if parts[0] == "tests" else "product"}:
            packages.setdefault(name, Counter()).update(counted)
    totals = [packages.pop(name) for name in ("product", "tests") if name in packages]
    print(f"{'':<28}" + "".join(f"{column:>12}" for column in COLUMNS))
    for name, counted in [*sorted(packages.items()), *zip(("product", "tests"), totals, strict=True)]:
        print(f"{name:<28}" + "".join(f"{counted[column]:>12,}" for column in COLUMNS))


if __name__ == "__main__":
    main(*sys.argv[1:])
