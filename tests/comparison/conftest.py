"""Run folders made by hand."""

import json
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest
import yaml

from nerf_lightning.runs.summaries import RunSummary, read_run
from tests.helpers.run_results import MakeRun, make_results


def run_maker(root: Path) -> MakeRun:
    """Writes a run's folder below a root and reads it: make_run(name, config={...}, psnr=..., ...)."""

    def make(name: str, config: dict[str, Any] | None = None, text: str | None = None, **changes: Any) -> RunSummary:
        folder = root / name
        folder.mkdir(parents=True)
        figures = make_results(**changes)
        plain = {
            "method": figures["method"],
            "recipe": None,
            "seed": figures["seed"],
            "dataset": {"path": f"/somewhere/{name}.npz", "rays": 64, "seed": figures["seed"]},
            "model": {"_target_": f"fields.{figures['method']}", "width": 16},
            "budget": {"steps": None, "seconds": 5},
            "callbacks": {"orbit": {"frames": figures["seed"]}},
        } | (config or {})
        if plain["recipe"] is not None:
            plain["model"] = plain["model"] | {"kind": plain["recipe"]}  # what a recipe stands for
        (folder / "config.yaml").write_text(yaml.safe_dump(plain, sort_keys=False))
        (folder / "results.json").write_text(json.dumps(figures) if text is None else text)
        for image, level in (("truth.png", 200), ("final.png", 100)):
            imageio.imwrite(folder / image, np.full((8, 12, 3), level, np.uint8))
        return read_run(folder)

    return make


@pytest.fixture
def make_run(tmp_path: Path) -> MakeRun:
    return run_maker(tmp_path / "runs")
