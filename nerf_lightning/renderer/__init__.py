"""Stage 5, renderer: Samples with density and rgb -> colour, opacity, depth."""

from nerf_lightning.renderer.renderer import FieldFn, Rendered, VolumeRenderer, over

__all__ = ["FieldFn", "Rendered", "VolumeRenderer", "over"]
