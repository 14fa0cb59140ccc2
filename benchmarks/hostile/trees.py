"""JSON and YAML damaged as what they are: mappings, lists, numbers and texts."""

import copy
import json
import re
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any

import yaml

from benchmarks.hostile import code, values

Place = tuple[Any, Any]
"""A mapping or list, and a key or index of it."""
RAW, AGAIN = "RAW{}RAW", "AGAIN_AGAIN_"
"""What stands for a piece of text until the tree is written, and begins a key that stands twice."""


class Written:
    """A tree while it is damaged, and pieces of text that no writer would write."""

    def __init__(self, tree: Any):
        self.top = {"": copy.deepcopy(tree)}
        self.raw: list[str] = []

    def token(self, text: str) -> str:
        self.raw.append(text)
        return RAW.format(len(self.raw) - 1)

    def text(self, as_json: bool) -> str:
        tree = self.top[""]
        text = json.dumps(tree) if as_json else yaml.dump(tree, sort_keys=False, Dumper=Plain, width=200)
        for i, raw in enumerate(self.raw):
            text = re.sub(f"[\"']?{RAW.format(i)}[\"']?", raw.replace("\\", r"\\"), text)
        return text.replace(AGAIN, "")


class Plain(yaml.SafeDumper):
    """Writes the same list twice where it stands twice."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def places(node: Any, key: Any, depth: int = 0) -> Iterator[tuple[int, Place]]:
    """Every place in a tree from `node[key]` on, and how deep it lies."""
    yield depth, (node, key)
    value = node[key]
    below = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    for one in below:
        yield from places(value, one, depth + 1)


def of_another_kind(value: Any) -> Any:
    """The value as something else."""
    if isinstance(value, dict):
        return list(value.items())
    if isinstance(value, list):
        return {str(i): one for i, one in enumerate(value)}
    if isinstance(value, str):
        return [value]
    return str(value)


def spoil(written: Written, rng: Random, marker: Path, as_json: bool) -> str:
    """Damages one place; returns what was done, in words."""
    by_depth: dict[int, list[Place]] = {}  # all depths alike: most places are single numbers of poses
    for depth, place in places(written.top, ""):
        by_depth.setdefault(depth, []).append(place)
    node, key = rng.choice(by_depth[rng.choice(sorted(by_depth))])
    name, old = str(key)[:40], node[key]
    match rng.randrange(14):
        case 0 | 1 | 2 | 3:
            node[key] = values.number(rng)
            return f"{name}: {str(node[key])[:30]}"
        case 4 | 5:
            node[key] = values.plain(rng)
            return f"{name}: {str(node[key])[:30]!r}"
        case 6:
            node[key] = of_another_kind(old)
            return f"{name}: another kind"
        case 7:
            if isinstance(node, dict) and node is not written.top:
                del node[key]
                return f"{name}: removed"
            node[key] = None
            return f"{name}: null"
        case 8:
            if isinstance(node, dict) and node is not written.top:
                node[AGAIN + str(key)] = values.plain(rng)
                return f"{name}: twice"
            node[key] = [old, old]
            return f"{name}: a list of itself"
        case 9:
            if isinstance(node, dict) and node is not written.top:
                node[rng.choice(values.TEXTS + (f"{key}_", str(key).upper()))] = node.pop(key)
                return f"{name}: renamed"
            node[key] = old[: len(old) // 2] if isinstance(old, list | str) else values.plain(rng)
            return f"{name}: half"
        case 10:
            node[key] = written.token(values.nested(rng))
            return f"{name}: nested deeply"
        case 11:
            raw = values.multiplied() if not as_json else "[" + "0," * 100_000 + "0]"
            node[key] = written.token(raw)
            return f"{name}: multiplied"
        case 12:
            node[key] = code.tree(rng, marker)
            return f"{name}: names code"
        case _:
            if as_json:
                node[key] = written.token(rng.choice(("1" + "0" * 5000, "-", "0x10", "1e999999", "'a'", "tru", "\x00")))
            else:
                node[key] = written.token(code.yaml_text(rng, marker))
            return f"{name}: text that is no value"


def damaged(text: str, rng: Random, marker: Path, as_json: bool) -> tuple[str, str]:
    """A document with one to three places damaged, and what was done."""
    written = Written(json.loads(text) if as_json else yaml.safe_load(text))
    done = [spoil(written, rng, marker, as_json) for _ in range(rng.choice((1, 1, 1, 2, 3)))]
    return written.text(as_json), "; ".join(done)
