"""Stage 5, renderer: Samples with density and rgb -> colour, opacity, depth."""

from nerf_lightning.renderer.renderer import FieldFn, Rendered, VolumeRenderer
from nerf_lightning.renderer.volume import accumulate, volume_weights

__all__ = ["FieldFn", "Rendered", "VolumeRenderer", "accumulate", "volume_weights"]
