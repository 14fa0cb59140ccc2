"""The page about a scene: one HTML file that opens without a network."""

import html
from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from nerf_lightning.drawing.panels import data_url
from nerf_lightning.inspect.quality import Photo

TEMPLATE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
<meta name="viewport" content="width=device-width">
<title>{name}</title>
<style>
body {{ font: 15px sans-serif; max-width: 1400px; margin: 1em auto; padding: 0 1em; color: black; background: white; }}
h1 {{ font-size: 22px; }} h2 {{ font-size: 17px; margin-top: 1.6em; }}
table {{ border-collapse: collapse; }} td {{ padding: 2px 14px 2px 0; vertical-align: top; }} td:first-child {{ color: #555; }}
.sheet {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(180px, 1fr)); gap: 10px; }}
figure {{ margin: 0; font-size: 12px; overflow-wrap: anywhere; }} figure img {{ width: 100%; display: block; }}
.bad {{ outline: 3px solid #D55E00; outline-offset: 1px; }} .bad figcaption, li {{ color: #A34700; }}
img.map {{ max-width: 100%; }}
</style>
</head>
<body>
<h1>{name}</h1>
<h2>Cameras</h2>
<img class="map" alt="cameras from above and from the side" src="{cameras}">
<h2>Scene</h2>
<table>{facts}</table>
<h2>What to look after</h2>
{doubts}
<h2>Photos</h2>
<div class="sheet">{sheet}</div>
</body>
</html>
"""


def inspection_page(
    name: str,
    facts: dict[str, str],
    doubts: Sequence[str],
    photos: Sequence[Photo],
    cameras: UInt8[np.ndarray, "H W 3"],
) -> str:
    """The page's HTML.

    Args:
        name: of the scene.
        facts: what it is, by name.
        doubts: what is wrong with it, in words.
        photos: all, with their troubles.
        cameras: a map of them.
    """
    rows = "".join(f"<tr><td>{html.escape(key)}</td><td>{html.escape(text)}</td></tr>" for key, text in facts.items())
    listed = "".join(f"<li>{html.escape(text)}</li>" for text in doubts)
    return TEMPLATE.format(
        name=html.escape(name),
        facts=rows,
        doubts=f"<ul>{listed}</ul>" if listed else "<p>Nothing was found.</p>",
        sheet="".join(map(_figure, photos)),
        cameras=data_url(cameras, ".png"),
    )


def _figure(photo: Photo) -> str:
    lines = [
        f"{photo.number}  {photo.name}",
        f"{photo.split}, sharpness {photo.sharpness:.2f}, brightness {photo.brightness:.2f}",
        *photo.troubles,
    ]
    caption = "<br>".join(map(html.escape, lines))
    look = ' class="bad"' if photo.troubles else ""
    return (
        f'<figure{look}><img alt="" src="{data_url(photo.small, ".jpg")}"><figcaption>{caption}</figcaption></figure>'
    )
