"""Names and sentences in the field's terms: no everyday words as names, and a glossary that points into the code."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[1]
GLOSSARY = ROOT / "docs" / "glossary.md"
FILES = [
    file
    for room in ("nerf_lightning", "conf", "benchmarks")
    for file in sorted((ROOT / room).rglob("*.*"))
    if "__pycache__" not in file.parts
]
PARTS = re.compile(r"(?:^|_)(?:told|untold|beside|apart|suited|wish|held(?!_?out)|lit|worth|evenly|mostly)(?:$|_)")
NAMES = r"around|behind|before|within|along|once|twice|kept|found|places?|share|spread|into|onto"
CONSTANTS = (
    "never|might|lots|room|sure|clearly|hurry|far|start|again|late|longest|shortest|deepest|farthest|most|least|many|some|few"
    "|whole|tiny|small|large|dense|steep|faint|thin|flat|hard|soft|clear|noisy|crowded|busy|usual|exact|plain|bare|empty"
)
PHRASES = re.compile(r".*\b(?:told|untold|beside|apart|suited|wish|so many|as many as there)\b.*", re.I)


def names_of(node: object) -> Iterator[tuple[str, bool]]:
    """Names of functions, classes, parameters, fields, YAML keys and modules' variables; True for the last."""
    if isinstance(node, dict | list):
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            yield from [(str(key), False), *names_of(value)]
    elif isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
        yield from [] if isinstance(node, ast.Module) else [(node.name, False)]
        yield from ((n.arg, False) for n in ast.walk(getattr(node, "args", ast.arguments())) if isinstance(n, ast.arg))
        for child in node.body:
            yield from names_of(child)
            if isinstance(child, ast.Assign | ast.AnnAssign) and not isinstance(node, ast.FunctionDef):
                targets = [n for target in getattr(child, "targets", [child]) for n in ast.walk(target)]
                names = [n.id for n in targets if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)]
                yield from ((name, isinstance(node, ast.Module)) for name in names)


def test_names_are_terms_of_the_field():
    banned, readers = [], {".py": ast.parse, ".yaml": yaml.safe_load}
    for file in FILES:
        names = names_of(readers[file.suffix](file.read_text("utf-8"))) if file.suffix in readers else ()
        for name, is_constant in [(file.stem, False), *names]:
            word = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().strip("_")
            if PARTS.search(word) or re.fullmatch(f"{NAMES}|{CONSTANTS}" if is_constant else NAMES, word):
                banned.append(f"{file.relative_to(ROOT)}: {name}")
    assert not banned, "\n".join(sorted(set(banned)))


def test_sentences_have_no_banned_phrase():
    texts = {f.relative_to(ROOT): f.read_text("utf-8") for f in FILES if f.suffix in (".py", ".yaml", ".html")}
    banned = [f"{path}: {found[0].strip()}" for path, text in texts.items() for found in PHRASES.finditer(text)]
    assert not banned, "\n".join(banned)


def test_glossary_terms_are_defined_once_and_used_in_code():
    rows = re.findall(r"^\| *([^|]+?) *\|[^|]+\| *(.*\(\.\./.+?) *\|$", GLOSSARY.read_text("utf-8"), re.M)
    assert len({term.lower() for term, _ in rows}) == len(rows) > 30
    for term, cell in rows:
        code = "".join((ROOT / path).read_text("utf-8") for path in re.findall(r"\(\.\./([^)]+)\)", cell))
        missing = [name for name in re.findall(r"`([\w.]+)`", cell) if name.rpartition(".")[2] not in code]
        assert code and not missing, f"{term}: {missing}"
