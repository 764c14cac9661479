"""`nisus query`: SQL over the archive of running twins, by DuckDB."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from app.render.text import to_text
from app.result import Cell, Topic, to_json
from estimators.errors import ConfigError, nearest

from .arguments import QueryCommand
from .parts import parts_of

ALL = "archive"
"""View with the rows of all twins."""


def query(arguments: QueryCommand) -> int:
    """Query an archive with SQL, and print the rows."""
    if arguments.json and arguments.csv:
        raise ConfigError("--json --csv: give one of them")
    result = result_of(arguments.folder, arguments.sql)
    if arguments.csv:
        import pyarrow.csv

        pyarrow.csv.write_csv(result, sys.stdout.buffer)
        return 0
    if arguments.json:
        print(to_json({"columns": result.column_names, "rows": [list(row.values()) for row in result.to_pylist()]}))
        return 0
    columns = (column.to_pylist() for column in result.columns)
    rows = tuple(tuple(_cell(value) for value in row) for row in zip(*columns, strict=True))
    title = f"{result.num_rows} row{'' if result.num_rows == 1 else 's'}"
    print(to_text([Topic(title, columns=tuple(result.column_names), rows=rows)]))
    return 0


def result_of(folder: Path, sql: str) -> Any:
    """Return the result of a SELECT over the archive in a folder as a pyarrow.Table.

    Nothing outside the folder is read, and nothing is written.

    Raises:
        ConfigError: If DuckDB is missing, the folder is no archive, or the statement is wrong or does more than read.
    """
    try:
        import duckdb
    except ImportError:
        raise ConfigError("query needs DuckDB: pip install 'nisus[archive]'") from None
    twins = {each.name: parts_of(each) for each in sorted(folder.glob("*")) if each.is_dir()}
    files = {name: [str(path.absolute()) for path in parts] for name, parts in twins.items() if parts}
    if not files:
        raise ConfigError(f"{folder}: there is no archive; name the folder given to `nisus run --archive`")
    with duckdb.connect() as connection:
        try:
            connection.execute("SET allowed_directories = ?", [[str(folder.absolute())]])
            connection.execute("SET enable_external_access = false")
            for name, paths in (*files.items(), (ALL, [path for each in files.values() for path in each])):
                listed = ", ".join(_quoted(path, "'") for path in paths)
                source = f"read_parquet([{listed}], union_by_name = true)"
                connection.execute(f"CREATE OR REPLACE VIEW {_quoted(name, chr(34))} AS SELECT * FROM {source}")
            connection.execute("SET lock_configuration = true")
            statements = connection.extract_statements(sql)
            if len(statements) != 1 or statements[0].type != duckdb.StatementType.SELECT:
                raise ConfigError(f"query: {_first_line(sql)}: must be one SELECT statement; an archive is only read")
            return connection.sql(statements[0]).to_arrow_table()
        except duckdb.CatalogException as error:
            names = [*files, ALL]
            raise ConfigError(f"query: {_first_line(error)}; {nearest(sql, names)}") from None
        except duckdb.Error as error:
            raise ConfigError(f"query: {_first_line(error)}") from None


def _first_line(error: object) -> str:
    return next(iter(str(error).strip().splitlines()), "")


def _quoted(text: str, mark: str) -> str:
    return f"{mark}{text.replace(mark, 2 * mark)}{mark}"


def _cell(value: object) -> Cell:
    """Return a value for a table: numbers as they are, anything else as text."""
    if value is None or isinstance(value, (int, float)) and not isinstance(value, bool):
        return value
    return str(value)
