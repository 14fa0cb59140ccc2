"""Stage 5, renderer: Samples with density and rgb -> color, opacity, depth."""

from nerf_lightning.renderer.background import Background
from nerf_lightning.renderer.renderer import FieldFn, RenderOutput, VolumeRenderer, composite_over

__all__ = ["Background", "FieldFn", "RenderOutput", "VolumeRenderer", "composite_over"]
