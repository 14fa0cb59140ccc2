"""Quality of each view, as a table and as plain values."""

from pathlib import Path

import pandas as pd
import torch

from nerf_lightning.utils.files import known
from nerf_lightning.utils.machine import describe_machine

DIGITS = {"psnr": 2, "ssim": 4, "lpips": 4, "seconds": 3}
"""Decimals of a view's figures. SSIM is nan for views smaller than its window, LPIPS where it cannot be computed."""


def format_table(views: pd.DataFrame) -> str:
    """All views, the worst marked, and their means."""
    rows = pd.concat([views, views.mean(skipna=False).to_frame("mean").T])
    table = pd.DataFrame({name: rows[name].map(f"{{:.{digits}f}}".format) for name, digits in DIGITS.items()})
    worst = views["psnr"] == views["psnr"].min()
    table[""] = ["<- worst" if mark and len(views) > 1 else "" for mark in (*worst, False)]
    names = {"psnr": "PSNR, dB", "ssim": "SSIM", "lpips": "LPIPS"}
    return table.rename(columns=names).replace("nan", "-").to_string()


def to_json(views: pd.DataFrame, source: Path, scene: dict[str, object], device: torch.device) -> dict[str, object]:
    """The evaluation as plain values; the mean of a figure that some view lacks is None."""
    machine = {"device": str(device), "machine": describe_machine(device)}
    records = views.reset_index(names="view").to_dict("records")
    figures = {"mean": known(views.mean(skipna=False).to_dict()), "views": known(records)}
    return {"run": str(source), "scene": scene, **machine, **figures}
