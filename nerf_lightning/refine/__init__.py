"""Pose refinement and color correction of the training photos, learned with the field."""

from nerf_lightning.refine.color_correction import ColorCorrection
from nerf_lightning.refine.corrections import Corrections
from nerf_lightning.refine.pose_refinement import PoseRefinement
from nerf_lightning.refine.report import format_report, summarize_corrections

__all__ = ["ColorCorrection", "Corrections", "PoseRefinement", "format_report", "summarize_corrections"]
