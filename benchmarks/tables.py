"""Tables of benchmark results."""

from statistics import median
from typing import Any

from rich import box
from rich.table import Table

Row = dict[str, Any]
Rows = list[Row]
"""Rows of tables. The key `table` names the row's table (default: the part), `differs` describes a mismatch."""


def name_tables(tables: dict[str, Rows]) -> Rows:
    """Labels the rows of several tables with their table's name."""
    return [{"table": name, **row} for name, rows in tables.items() for row in rows]


def group_by_table(part: str, rows: Rows) -> dict[str, Rows]:
    """Groups rows by table."""
    tables: dict[str, Rows] = {}
    for row in rows:
        tables.setdefault(row.get("table", part), []).append({k: v for k, v in row.items() if k != "table"})
    return tables


def list_differences(rows: Rows) -> list[str]:
    """Kernel, method or recipe and mismatch of each row that has one."""
    names = "kernel", "method", "recipe"
    return [f"{next(filter(None, map(row.get, names)))} ({row['differs']})" for row in rows if row.get("differs")]


def compute_medians(rows: Rows) -> Row:
    """Median of each column."""
    return {key: median(row[key] for row in rows) for key in rows[0]}


def format_cell(value: Any) -> str:
    """Formats a value to four significant figures."""
    if value is None:
        return "-"
    if isinstance(value, float | int) and not isinstance(value, bool):
        return f"{value / 1e6:.1f}M" if value >= 1e6 else f"{value:.4g}"
    return str(value)


def make_rich_table(name: str, rows: Rows) -> Table:
    """Makes a table with a column for every key."""
    table = Table(title=name, title_justify="left", box=box.SIMPLE_HEAD)
    keys = list(dict.fromkeys(key for row in rows for key in row))
    for key in keys:
        table.add_column(key, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*(format_cell(row.get(key)) for key in keys))
    return table
