"""What a search leaves: rightsize.json, chart.png, and best.yaml, an experiment of its own."""

from pathlib import Path
from typing import Any

import yaml
from matplotlib.figure import Figure
from omegaconf import DictConfig

from nerf_lightning.drawing.ink import BLUE, DPI, GREY, ORANGE, VERMILLION, pixels_of
from nerf_lightning.drawing.panels import write_png
from nerf_lightning.rightsize.choose import knee
from nerf_lightning.rightsize.climb import Rung, set_options
from nerf_lightning.rightsize.ladder import overrides
from nerf_lightning.rightsize.search import Found, Full, figures
from nerf_lightning.rightsize.start import REPORT
from nerf_lightning.runs.folder import plain_config
from nerf_lightning.utils.files import atomic, write_json
from nerf_lightning.utils.machine import describe_machine

CHOSEN_FROM = ("dataset", "model", "sampler", "renderer", "optimizer", "schedule", "callbacks", "logger", "trainer")
"""Groups whose option best.yaml names ..."""
WRITTEN = ("dataset", "model", "sampler", "renderer", "optimizer", "schedule")
"""... and those whose values it holds."""


def write_report(found: Found, cfg: DictConfig, choices: dict[str, Any], output: Path) -> None:
    """Writes all files, and says what was found.

    Args:
        found: by the search.
        cfg: the run's configuration, before options of a rung.
        choices: which option of each Hydra group was taken.
        output: the folder.
    """
    write_png(output / "chart.png", pixels_of(chart(found)))
    with atomic(output / "best.yaml") as temporary:
        temporary.write_text(experiment(found, cfg, choices), encoding="utf-8")
    write_json(output / REPORT, as_json(found))  # last: with it the search is done
    one = found.full[found.choice]
    print(found.reason)
    print(
        f"{output}/compact.npz: {figures(found.compact.psnr, len(found.compact.content))}; the search took"
        f" {found.seconds:.0f} s of training, {found.seconds / one.seconds:.1f} times that of the choice"
    )
    print(
        f"again: python -m nerf_lightning +experiment={output}/best.yaml; all rungs: {output}/chart.png, rightsize.json"
    )


def as_json(found: Found) -> dict[str, Any]:
    """The search as plain values."""
    rungs = []
    for index, options in enumerate(found.ladder.rungs):
        full = found.full.get(index)
        grown = found.rungs[index] if index < len(found.rungs) else None
        known: Full | Rung | None = full or grown
        if known is None:
            break
        rungs.append(
            {
                "overrides": overrides("model", options),
                "parameters": known.parameters,
                "artifact_bytes": known.size,
                "psnr": known.psnr,
                "train_seconds": known.seconds,
                "grown_psnr": None if grown is None else grown.psnr,
                "run": None if full is None else str(full.folder),
            }
        )
    chosen = found.full[found.choice]
    return {
        "target": {"psnr": found.target.psnr, "within_db": found.target.within_db},
        "reached": found.reached,
        "reason": found.reason,
        "knee": knee(found.rungs),
        "device": str(found.device),
        "machine": describe_machine(found.device),
        "noise_db": round(found.noise, 4),
        "search_seconds": round(found.seconds, 3),
        "wall_seconds": round(found.wall_seconds, 3),
        "chosen": {
            "rung": found.choice,
            "overrides": [*overrides("model", found.ladder.rungs[found.choice]), *overrides("sampler", found.sampler)],
            "artifact_bytes": len(found.compact.content),
            "psnr": found.compact.psnr,
            "train_seconds": chosen.seconds,
            "run": str(chosen.folder),
        },
        "rungs": rungs,
    }


def experiment(found: Found, cfg: DictConfig, choices: dict[str, Any]) -> str:
    """The choice as an experiment: all that sets it apart from the defaults."""
    best = set_options(cfg, "model", found.ladder.rungs[found.choice])
    plain = plain_config(set_options(best, "sampler", found.sampler))
    content: dict[str, Any] = {
        "defaults": [{f"override /{group}": choices.get(group)} for group in CHOSEN_FROM],
        "name": f"{plain['name']}_rightsized",
    }
    for group in WRITTEN:
        if plain.get(group) is not None:
            content[group] = {key: value for key, value in plain[group].items() if not key.startswith("_")}
    content["budget"] = plain["budget"]
    return f"# @package _global_\n# {found.reason}\n{yaml.safe_dump(content, sort_keys=False)}"


def chart(found: Found) -> Figure:
    """Bytes against PSNR: the climb, the full trainings, the target, and the choice."""
    figure = Figure(figsize=(7.2, 4.6), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    grown = found.rungs
    sizes = [one.size / 1000 for one in grown]
    axes.plot(sizes, [one.psnr for one in grown], "o-", color=BLUE, mfc="white", label="while growing")
    for index, one in enumerate(grown):
        above = (0, 6) if index % 2 else (0, -14)  # neighbours may be as large as each other
        axes.annotate(str(index), (sizes[index], one.psnr), above, textcoords="offset points", ha="center")
    bend = knee(grown)
    axes.plot(sizes[bend], grown[bend].psnr, "D", color=BLUE, ms=9, label=f"knee: rung {bend}")
    whole = found.full.values()
    label = "trained in full"
    axes.plot([one.size / 1000 for one in whole], [one.psnr for one in whole], "s", color=ORANGE, ms=8, label=label)
    chosen, label = found.full[found.choice], f"chosen: rung {found.choice}"
    axes.plot(chosen.size / 1000, chosen.psnr, "o", ms=19, mfc="none", mec=VERMILLION, mew=2, label=label)
    enough = found.target.psnr
    if enough is None:
        enough = max(one.psnr for one in whole) - (found.target.within_db or 0.0)
    axes.axhline(enough, color=GREY, lw=1, ls="--", label=f"enough: {enough:.2f} dB")
    axes.set(xscale="log", xlabel="compact file, kB", ylabel="held-out PSNR, dB", title="What each size is worth")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    return figure
