"""What the render verb is asked for. Imports nothing heavy."""

from dataclasses import dataclass
from typing import Annotated

from nerf_lightning.utils.options import AtLeast, Count


@dataclass(frozen=True)
class RenderOptions:
    """The keys of conf/render.yaml, which says what each means; `photos` is its dataset.path."""

    run: str
    path: str
    frames: Count | None
    fps: Annotated[float, AtLeast(0.01)]
    background: str | list[float]
    scale: Annotated[float, AtLeast(0.001)]
    channels: str | list[str]
    output: str | None
    device: str
    photos: str | None
