"""The plan of the package: imports run one way, from room to room."""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ORDER = (
    ("errors",),
    ("utils",),
    ("cameras",),
    ("kernels",),
    ("dataset", "model", "refine"),
    ("synthetic",),
    ("sources",),
    ("sampler",),  # some have a small field of their own
    ("renderer",),
    ("system",),
    ("drawing",),
    ("callbacks",),
    ("config",),
    ("runs",),
    ("capture", "check", "comparison", "evaluate", "export", "render", "view"),
    ("training",),
    ("stability", "sizing"),
    ("cli",),
    ("api", "__main__"),
    ("__init__",),
)
"""Each room may import from those above it."""
UP = {("callbacks", "view")}
"""While a field trains, a callback may show the page that the verb shows of a finished one."""


def imported_rooms(file: Path) -> set[str]:
    """The rooms a module takes something from."""
    nodes = [node for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))) if isinstance(node, ast.ImportFrom)]
    return {(node.module or "").split(".")[1] for node in nodes if (node.module or "").startswith("nerf_lightning.")}


def test_imports_between_rooms_run_one_way():
    level = {room: number for number, rooms in enumerate(ORDER) for room in rooms}
    package = ROOT / "nerf_lightning"
    found = set()
    for file in package.rglob("*.py"):
        room = file.relative_to(package).parts[0].removesuffix(".py")
        found |= {(room, other) for other in imported_rooms(file) - {room}}
    assert len(found) > 50
    assert {(room, other) for room, other in found if level[room] <= level[other]} == UP
