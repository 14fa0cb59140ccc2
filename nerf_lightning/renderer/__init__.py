"""Stage 5, renderer: Samples with density and rgb -> color, opacity, depth."""

from nerf_lightning.kernels import composite_over
from nerf_lightning.renderer.background import Background
from nerf_lightning.renderer.checkerboard import render_checkerboard
from nerf_lightning.renderer.renderer import FieldFn, RenderOutput, VolumeRenderer

__all__ = ["Background", "FieldFn", "RenderOutput", "VolumeRenderer", "composite_over", "render_checkerboard"]
