"""Between cameras and samplers: small corrections of cameras and light, learned together with the field."""

from nerf_lightning.refine.corrections import Corrections
from nerf_lightning.refine.found import summary, told

__all__ = ["Corrections", "summary", "told"]
