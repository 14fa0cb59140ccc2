"""What a run writes, for tests that make runs by hand."""

from collections.abc import Callable
from typing import Any

from nerf_lightning.runs.summaries import RunSummary

MakeRun = Callable[..., RunSummary]


def make_results(**changes: Any) -> dict[str, Any]:
    """A results.json as a run writes it, with some entries changed."""
    scene = {"name": "toy", "source": "built-in", "sha256": "ab" * 32}
    scene |= {"views": {"train": 9, "val": 2}, "resolution": [8, 6]}
    whole = {
        "scene": scene, "background": [0.0, 0.0, 0.0], "method": "grid", "seed": 0, "device": "cpu", "threads": 2,
        "machine": {"processor": "abacus", "cores": 2, "accelerator": None}, "load": {"own": 1.9, "others": 0.02},
        "versions": {"nerf_lightning": "1"}, "parameters": 10, "artifact_bytes": 40_000, "train_seconds": 5.01,
        "steps": 100, "psnr": 30.0, "render_seconds_per_view": 0.1, "curve": [[1.0, 20, 25.0], [5.01, 100, 30.0]],
        "status": "finished", "diagnosis": "",
    }  # fmt: skip
    return whole | changes
