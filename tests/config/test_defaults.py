"""One set of defaults: what a signature says in Python is what conf/ says on the command line."""

import inspect
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import yaml
from hydra.utils import get_object

from nerf_lightning.config import conf_dir


def targets(node: Any) -> Iterator[dict[str, Any]]:
    """All nodes of a file with a target in this package."""
    if isinstance(node, dict):
        if str(node.get("_target_", "")).startswith("nerf_lightning."):
            yield node
        for value in node.values():
            yield from targets(value)


def test_conf_defaults_match_signatures():
    written: dict[tuple[str, str], list[Any]] = defaultdict(list)
    for file in sorted(conf_dir().rglob("*.yaml")):
        for node in targets(yaml.safe_load(file.read_text(encoding="utf-8"))):
            for key, value in node.items():
                if not key.startswith("_") and "$" not in str(value) and key != "url":  # which has no default
                    written[node["_target_"], key].append(value)
    differing = []
    for (target, key), values in written.items():
        default = inspect.signature(get_object(target)).parameters[key].default
        # Two files may be two ways of one target, as sampler/uniform and sampler/stratified are.
        if default is not inspect.Parameter.empty and default not in values:
            differing.append(f"{target}({key}={default!r}), conf/ {values}")
    assert len(written) > 90 and not differing, "\n".join(differing)
