"""What the render verb is asked for. Imports nothing heavy."""

from dataclasses import dataclass
from typing import Annotated

from nerf_lightning.utils.options import AtLeast, AtMost, Count, FramesPerSecond


@dataclass(frozen=True)
class RenderOptions:
    """The keys of conf/render.yaml, which says what each means; `photos` is its dataset.path."""

    run: str
    path: str
    path_frame: str
    frames: Annotated[Count, AtMost(99_999)] | None
    """Files of frames are numbered with five digits, which keep them in order."""
    fps: FramesPerSecond
    background: str | list[float]
    scale: Annotated[float, AtLeast(0.001), AtMost(1000)]
    channels: str | list[str]
    output: str | None
    device: str
    photos: str | None
