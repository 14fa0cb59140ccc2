"""Output of a size search: rightsize.json, chart.png, and best.yaml, an experiment."""

from pathlib import Path
from typing import Any

import yaml
from hydra.core.hydra_config import HydraConfig
from matplotlib.figure import Figure
from omegaconf import DictConfig

from nerf_lightning.drawing.panels import write_png
from nerf_lightning.drawing.style import BLUE, DPI, GRAY, ORANGE, VERMILLION, rasterize_figure
from nerf_lightning.runs.folder import config_to_dict
from nerf_lightning.sizing.search import format_figures, set_options
from nerf_lightning.utils.files import atomic_write, write_json

REPORT_FILE = "rightsize.json"
"""Written last: marks a finished search."""
EXPERIMENT_GROUPS = ("dataset", "model", "sampler", "renderer", "optimizer", "schedule")
"""Config groups stored in best.yaml."""


def write_report(result: dict[str, Any], cfg: DictConfig, output: Path) -> None:
    """Writes all files, from the result of `search_sizes` and the base configuration."""
    write_png(output / "chart.png", rasterize_figure(draw_chart(result)))
    with atomic_write(output / "best.yaml") as temporary:
        temporary.write_text(format_experiment(result, cfg), encoding="utf-8")
    write_json(output / REPORT_FILE, result)


def explain_choice(result: dict[str, Any], output: Path) -> str:
    """Summarizes the choice, its reason and its files for the terminal."""
    target, rung = result["target"], str(result["rung"])
    lines = [f"rung {name} reaches {entry['psnr']:.2f} dB trained in full" for name, entry in result["full"].items()]
    if target["psnr"] is None:
        goal = f"{target['within_db']:g} dB below the best are allowed"
    else:
        goal = f"the target of {target['psnr']:g} dB was {'' if result['reached'] else 'not '}reached"
    lines[-1] += f"; {goal}: rung {rung}"
    ratio = result["search_seconds"] / result["full"][rung]["seconds"]
    lines += [
        f"{output}/compact.npz: {format_figures(result['psnr'], result['artifact_bytes'])}; the search took"
        f" {result['search_seconds']:.0f} s of training, {ratio:.1f} times that of the choice",
        f"again: nerf_lightning train +experiment={output}/best.yaml; all rungs: {output}/chart.png, {REPORT_FILE}",
    ]
    return "\n".join(lines)


def format_experiment(result: dict[str, Any], cfg: DictConfig) -> str:
    """Formats the choice as an experiment in YAML, with all options that differ from the defaults."""
    plain = config_to_dict(set_options(set_options(cfg, "model", result["model"]), "sampler", result["sampler"]))
    choices = HydraConfig.get().runtime.choices
    groups = (*EXPERIMENT_GROUPS, "callbacks", "logger", "trainer")
    content: dict[str, Any] = {
        "defaults": [{f"override /{group}": choices.get(group)} for group in groups],
        "name": f"{plain['name']}_rightsized",
        "budget": plain["budget"],
    }
    for group in EXPERIMENT_GROUPS:
        if plain.get(group) is not None:
            content[group] = {key: value for key, value in plain[group].items() if not key.startswith("_")}
    return f"# @package _global_\n{yaml.safe_dump(content, sort_keys=False)}"


def draw_chart(result: dict[str, Any]) -> Figure:
    """Plots PSNR against bytes: rungs while growing, full trainings, the target and the choice."""
    growing, full, chosen = result["growing"], result["full"].values(), result["full"][str(result["rung"])]
    target = result["target"]
    threshold = max(entry["psnr"] for entry in full) - target["within_db"] if target["psnr"] is None else target["psnr"]
    figure = Figure(figsize=(7.2, 4.6), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    kinds = ((growing, "o-", BLUE, "white", "while growing"), (full, "s", ORANGE, ORANGE, "trained in full"))
    for rungs, style, color, fill, label in kinds:
        sizes, figures = [entry["size"] / 1000 for entry in rungs], [entry["psnr"] for entry in rungs]
        axes.plot(sizes, figures, style, color=color, ms=8, mfc=fill, label=label)
    for rung, entry in enumerate(growing):
        offset = (0, 8) if rung % 2 else (0, -16)  # neighbors may have equal sizes
        point = entry["size"] / 1000, entry["psnr"]
        axes.annotate(str(rung), point, offset, textcoords="offset points", ha="center")
    point = chosen["size"] / 1000, chosen["psnr"]
    axes.plot(*point, "o", ms=19, mfc="none", mec=VERMILLION, mew=2, label=f"chosen: rung {result['rung']}")
    axes.axhline(threshold, color=GRAY, lw=1, ls="--", label=f"enough: {threshold:.2f} dB")
    axes.set(xscale="log", xlabel="compact file, kB", ylabel="held-out PSNR, dB", title="Quality by size")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.margins(0.08, 0.12)
    axes.grid(alpha=0.3)
    axes.legend(loc="best")
    return figure
