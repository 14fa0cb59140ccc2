"""What the export verb is asked for. Imports nothing heavy."""

from dataclasses import dataclass
from typing import Annotated

from nerf_lightning.utils.options import AtLeast, Side


@dataclass(frozen=True)
class ExportOptions:
    """The keys of conf/export.yaml, which says what each means; `photos` is its dataset.path."""

    run: str
    format: str
    output: str | None
    precision: str | None
    loss: Annotated[float, AtLeast(0)]
    content: str
    resolution: Side | None
    threshold: float | None
    box: list[float] | None
    device: str
    photos: str | None
