"""Rows that are measured, and the tables that they make."""

from statistics import median
from typing import Any

from rich import box
from rich.table import Table

Row = dict[str, Any]
Rows = list[Row]
"""Lines of tables. The key `table` names another table than the part's own, `differs` says what is not as it should be."""


def name_tables(tables: dict[str, Rows]) -> Rows:
    """The rows of several tables, each with the name of its own."""
    return [{"table": name, **row} for name, rows in tables.items() for row in rows]


def group_by_table(part: str, rows: Rows) -> dict[str, Rows]:
    """Rows by the table that they belong to."""
    tables: dict[str, Rows] = {}
    for row in rows:
        tables.setdefault(row.get("table", part), []).append({k: v for k, v in row.items() if k != "table"})
    return tables


def list_differences(rows: Rows) -> list[str]:
    """What is not as it should be: the first entry of each such row, and why."""
    return [f"{row.get('kernel') or row.get('method')} ({row['differs']})" for row in rows if row.get("differs")]


def compute_medians(rows: Rows) -> Row:
    """The middle value of each column."""
    return {key: median(row[key] for row in rows) for key in rows[0]}


def format_cell(value: Any) -> str:
    """A value to four figures."""
    if value is None:
        return "-"
    if isinstance(value, float | int) and not isinstance(value, bool):
        return f"{value / 1e6:.1f}M" if value >= 1e6 else f"{value:.4g}"
    return str(value)


def make_rich_table(name: str, rows: Rows) -> Table:
    """A table with a column for every key."""
    table = Table(title=name, title_justify="left", box=box.SIMPLE_HEAD)
    keys = list(dict.fromkeys(key for row in rows for key in row))
    for key in keys:
        table.add_column(key, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*(format_cell(row.get(key)) for key in keys))
    return table
