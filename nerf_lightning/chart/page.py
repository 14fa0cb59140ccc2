"""The chart as one HTML file that opens without a network and shows each point's configuration."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nerf_lightning.chart.advice import in_bytes
from nerf_lightning.chart.comparison import COSTS, Comparison
from nerf_lightning.chart.points import Point
from nerf_lightning.chart.references import Reference
from nerf_lightning.runs.index import FIELD_PAGE
from nerf_lightning.utils.machine import crowding
from nerf_lightning.utils.text import relative_url, script_data

TEMPLATE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width">
<title>Speed against accuracy</title>
<style>
body {{ margin: 0; font: 14px sans-serif; background: white; color: black; }}
svg {{ width: 100%; max-width: 1500px; height: auto; display: block; margin: auto; }}
p {{ max-width: 1400px; margin: .6em auto; color: #555; }}
#card {{ position: fixed; display: none; box-sizing: border-box; max-width: min(760px, 96vw); padding: 10px 14px;
  background: white; border: 1px solid #888; border-radius: 6px; box-shadow: 2px 3px 12px #0004; pointer-events: none; }}
#card.kept {{ pointer-events: auto; }} #card a {{ display: block; margin: 6px 0; }}
#card b {{ display: block; margin-bottom: 4px; font-size: 15px; }}
#card dl {{ margin: 0; display: grid; grid-template-columns: max-content auto; gap: 0 10px; }}
#card dl + dl {{ margin-top: 8px; padding-top: 8px; border-top: 1px solid #ccc; font-size: 11px;
  grid-template-columns: max-content auto max-content auto; }}
dt {{ color: #555; }} dd {{ margin: 0; overflow-wrap: anywhere; }}
[data-point] {{ cursor: pointer; outline: none; }}
[data-point] * {{ pointer-events: all; }}
.lit {{ filter: drop-shadow(0 0 2px #d00) drop-shadow(0 0 5px #d00); }}
</style>
</head>
<body>
{svg}
<p>Point at a marker to see its configuration. A click keeps the card open; another click closes it.</p>
<div id="card" role="status"></div>
<script type="application/json" id="points">{points}</script>
<script>
"use strict";
const points = JSON.parse(document.getElementById("points").textContent);
const card = document.getElementById("card");
let kept = null;
const marks = name => points[name].marks.map(id => document.getElementById(id)).filter(Boolean);
function list(pairs) {{
  const node = document.createElement("dl");
  for (const [key, value] of pairs) {{
    const term = document.createElement("dt"), told = document.createElement("dd");
    term.textContent = key; told.textContent = value; node.append(term, told);
  }}
  return node;
}}
function show(name, place) {{
  hide();
  const title = document.createElement("b");
  title.textContent = points[name].title;
  card.append(title, list(points[name].figures));
  if (points[name].page) {{
    const link = document.createElement("a");
    link.href = points[name].page; link.target = "_blank"; link.rel = "noopener"; link.textContent = "turn the result";
    card.append(link);
  }}
  card.classList.toggle("kept", kept !== null);
  if (points[name].options.length) card.append(list(points[name].options));
  card.style.display = "block";
  const box = card.getBoundingClientRect(), gap = 16;
  const x = place.x + gap + box.width < innerWidth ? place.x + gap : Math.max(0, place.x - gap - box.width);
  const y = Math.max(4, Math.min(place.y + gap, innerHeight - box.height - 4));
  card.style.left = x + "px"; card.style.top = y + "px";
  marks(name).forEach(mark => mark.classList.add("lit"));
}}
function hide() {{
  card.replaceChildren(); card.style.display = "none";
  document.querySelectorAll(".lit").forEach(mark => mark.classList.remove("lit"));
}}
for (const name of Object.keys(points)) for (const mark of marks(name)) {{
  mark.setAttribute("data-point", name); mark.setAttribute("tabindex", "0");
  mark.setAttribute("aria-label", points[name].title);
  mark.addEventListener("pointerenter", event => {{ if (!kept) show(name, event); }});
  mark.addEventListener("pointerleave", () => {{ if (!kept) hide(); }});
  mark.addEventListener("focus", () => {{ if (!kept) show(name, mark.getBoundingClientRect()); }});
  mark.addEventListener("blur", () => {{ if (!kept) hide(); }});
  mark.addEventListener("click", event => {{
    kept = kept === name ? null : name; event.stopPropagation(); show(name, event);
  }});
}}
document.addEventListener("click", () => {{ kept = null; hide(); }});
document.addEventListener("keydown", event => {{ if (event.key === "Escape") {{ kept = null; hide(); }} }});
</script>
</body>
</html>
"""


def chart_page(svg: str, comparisons: Sequence[Comparison], folder: Path) -> str:
    """The page.

    Args:
        svg: what `chart_figure` drew of the same comparisons.
        comparisons: what it shows.
        folder: where the page will be: a point whose run has a page of its own links to that.
    """
    told: dict[str, dict[str, Any]] = {}
    for row, one in enumerate(comparisons):
        for number, point in enumerate(one.points):
            marks = [f"{cost.name}-{row}-{number}" for cost in COSTS]
            told[f"{row}-{number}"] = {"marks": marks, **_card(point, one.on_frontier(number), folder)}
        for number, reference in enumerate(one.references):
            told[f"published-{row}-{number}"] = {"marks": [f"published-{row}-{number}"], **_published(reference)}
    return TEMPLATE.format(svg=svg[svg.index("<svg") :], points=script_data(told))


def _card(point: Point, fronts: Sequence[str], folder: Path) -> dict[str, Any]:
    seeds = ", ".join(
        f"{run.results.get('seed')}: {'no figure' if run.psnr is None else f'{run.psnr:.2f} dB'}"
        + ("" if run.status == "finished" else f" ({run.status})")
        for run in point.runs
    )
    figures = [
        ("held-out PSNR", f"{point.psnr:.2f} dB, median of {len(point.runs)}"),
        ("seeds", seeds),
        ("training", f"{point.seconds:.3g} s, {point.typical.results.get('steps')} steps"),
        ("rendering", "not measured" if point.render is None else f"{point.render:.3g} s a view"),
        ("artifact", "unknown" if point.size is None else in_bytes(point.size)),
        ("Pareto frontier", ", ".join(fronts) or "no"),
        ("setting", point.setting.words()),
        ("other work", _load(point)),
        ("folder", str(point.typical.folder)),
    ]
    left_out = [key for key in point.configuration if key.startswith("trainer.") or key.endswith("_partial_")]
    options = [(key, str(value)) for key, value in point.configuration.items() if key not in left_out]
    page = point.typical.folder / FIELD_PAGE
    address = relative_url(folder, page) if page.is_file() else None
    return {"title": point.label, "figures": figures, "options": options, "page": address}


def _load(point: Point) -> str:
    shares = [share for run in point.runs if (share := crowding(run.results)) is not None]
    return f"took up to {max(shares):.0%} of the threads" if shares else "not recorded"


def _published(reference: Reference) -> dict[str, Any]:
    figures = [
        ("published, other hardware", reference.hardware),
        ("held-out PSNR", f"{reference.psnr:g} dB"),
        ("training", f"{reference.seconds:g} s"),
        ("measured on", f"{reference.scene}, {reference.conditions}"),
        ("source", reference.source),
    ]
    return {"title": reference.name, "figures": figures, "options": [], "page": None}
