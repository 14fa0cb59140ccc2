"""The plan of the package: imports run one way, from room to room."""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ORDER = (
    *(("errors",), ("utils",), ("cameras",), ("kernels",)),
    *(("dataset", "model", "refine"), ("synthetic",), ("datamodules",)),
    *(("sampler",), ("renderer",), ("system",), ("drawing",), ("callbacks",)),  # some samplers have a small field
    *(("config",), ("runs",)),
    ("capture", "check", "comparison", "evaluate", "export", "render", "view"),
    *(("training",), ("stability", "sizing"), ("cli",), ("api", "__main__"), ("__init__",)),
)
"""Each room may import from those above it."""
UP = {("callbacks", "view")}
"""While a field trains, a callback may show the page that the verb shows of a finished one."""


def find_imported_packages(file: Path) -> set[str]:
    """The rooms a module takes something from."""
    nodes = [node for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))) if isinstance(node, ast.ImportFrom)]
    return {(node.module or "").split(".")[1] for node in nodes if (node.module or "").startswith("nerf_lightning.")}


def test_imports_between_packages_run_one_way():
    level = {room: number for number, rooms in enumerate(ORDER) for room in rooms}
    package = ROOT / "nerf_lightning"
    found = set()
    for file in package.rglob("*.py"):
        room = file.relative_to(package).parts[0].removesuffix(".py")
        found |= {(room, other) for other in find_imported_packages(file) - {room}}
    assert len(found) > 50
    assert {(room, other) for room, other in found if level[room] <= level[other]} == UP


CORE = ("model", "sampler", "renderer", "refine", "system", "callbacks", "training")
OWN = {"self", "ctx", "history"}
"""An object itself, what autograd gives a function of its own, and the guard's record."""
OUTSIDE = {"torch", "trainer", "function"}
"""Objects of torch, Lightning and functools."""


def test_core_sets_no_attribute_of_another_object():
    found = []
    for file in (file for room in CORE for file in (ROOT / "nerf_lightning" / room).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
                owner = ast.unparse(node).split(".")[0]
                if owner not in OWN | OUTSIDE and node.attr not in ("data", "grad"):  # of a tensor
                    found.append(f"{file.name}:{node.lineno}: {ast.unparse(node)}")
    assert found == []


KINDS = {"NeRF2D", "NeRF3D", "System", "PixelDataModule", "RayDataModule", "Picture", "Scene"}


def test_dimension_is_decided_in_one_place():
    """2D or 3D is decided where a system is built for its data; else their methods differ."""
    found = []
    for file in (ROOT / "nerf_lightning").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "isinstance":
                names = {one.id for one in ast.walk(node.args[1]) if isinstance(one, ast.Name)}
                found += [f"{file.parent.name}/{file.name}"] * bool(names & KINDS)
    assert found == ["config/build.py"]
