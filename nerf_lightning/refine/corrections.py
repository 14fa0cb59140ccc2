"""Corrections: pose refinement and color correction of the training photos, and their learning rates."""

from collections.abc import Sequence
from typing import Any

import torch

from nerf_lightning.cameras import Bounds, Cameras
from nerf_lightning.errors import InputError
from nerf_lightning.refine.color_correction import ColorCorrection
from nerf_lightning.refine.pose_refinement import PoseRefinement
from nerf_lightning.utils.option_checks import PositiveFloat

START_PROGRESS = 0.02
"""Refinement starts after this fraction of training, once the field has coarse content."""
LR_FINAL_FACTOR = 0.1
"""Factor on the learning rates at the end."""
BOOST_PROGRESS, BOOST_MOTION_PX, POSE_LR_BOOST = 0.1, 4.0, 3.0
"""Poses learn `POSE_LR_BOOST` times as fast for this fraction of training, and later in proportion to their RMS motion above
`BOOST_MOTION_PX`, so that large errors converge."""
GROWTH_DELAY_PROGRESS = 0.4
"""Fraction of training from the start of pose refinement until the field has its full size."""
REQUIRED_CORRECTION = {"focal": "poses", "affine": "exposure", "vignetting": "exposure"}
"""Correction that each option belongs to."""


class Corrections(torch.nn.Module):
    """Pose refinement and color correction of the training photos.

    Args:
        cameras: of the V photos, as given.
        bounds: of the content.
        exposures: see `ColorCorrection`; they initialize the gains, with `auto` only if that lowers the error.
        poses: refines rotation and translation of each camera.
        exposure: learns gains of each photo.
        focal: with `poses`, also refines the focal length, one factor for all photos.
        affine, vignetting: with `exposure`, see `ColorCorrection`.
        pose_lr: learning rate of poses, in pixels of content motion per step.
        exposure_lr: learning rate of the log gains.
        auto: enables a correction only once a trial shows that it helps.
        fix_gauge: projects out gauge freedom (global similarity, mean gain); false for photos of a trained field.

    Raises:
        InputError: if nothing is to be corrected, and for an option without its correction.
    """

    def __init__(
        self,
        cameras: Cameras,
        bounds: Bounds,
        exposures: Sequence[float] = (),
        poses: bool = True,
        exposure: bool = True,
        focal: bool = False,
        affine: bool = False,
        vignetting: bool = False,
        pose_lr: PositiveFloat = 0.1,
        exposure_lr: PositiveFloat = 0.003,
        auto: bool = False,
        fix_gauge: bool = True,
    ):
        super().__init__()
        self.learning_rates = {"poses": pose_lr} if poses else {}
        self.learning_rates |= {"exposure": exposure_lr} if exposure else {}
        if not self.learning_rates:
            found, hint = "false, with refine.exposure=false", "or give refine=null"
            raise InputError("refine.poses", "", found, "one of them", hint)
        for part, is_enabled in {"focal": focal, "affine": affine, "vignetting": vignetting}.items():
            if is_enabled and (required := REQUIRED_CORRECTION[part]) not in self.learning_rates:
                found, hint = f"true, with refine.{required}=false", f"or give refine.{required}=true"
                raise InputError(f"refine.{part}", "", found, "false", hint)
        self.poses = PoseRefinement(cameras, bounds, focal, fix_gauge)
        self.color = ColorCorrection(cameras, exposures, affine, vignetting, fix_gauge)
        self.auto = auto
        self.last_error_reduction: dict[str, float] = {}
        """Relative error reduction of each correction in the last trial of `auto`."""
        self.enabled_at: dict[str, float] = {}
        """Training progress at which each correction was enabled."""
        if not auto:
            self.enable(START_PROGRESS, *self.learning_rates)
            if exposure:
                self.color.init_from_exif()

    def group_parameters(self, name: str) -> list[torch.nn.Parameter]:
        """Parameters of "poses" or "exposure"."""
        return list((self.poses if name == "poses" else self.color).parameters())

    def enable(self, progress: float, *names: str) -> None:
        """Enables corrections from now on."""
        for name in names:
            self.enabled_at[name] = progress
            for parameter in self.group_parameters(name):
                parameter.requires_grad_(True)

    def enable_poses(self) -> None:
        """Enables pose refinement from the first step on, for poses known to be wrong: a field that explains large errors by
        fog would let no trial detect them."""
        if "poses" in self.learning_rates and "poses" not in self.enabled_at:
            self.enable(0.0, "poses")

    def record_trial(
        self, progress: float, names: Sequence[str], error_reductions: dict[str, float], init_from_exif: bool
    ) -> None:
        """Records a trial of `auto` and enables what helps.

        Args:
            progress: of the training.
            names: corrections that help.
            error_reductions: see `last_error_reduction`.
            init_from_exif: whether gains start from the stated exposures.
        """
        self.last_error_reduction |= error_reductions
        self.enable(progress, *names)
        if "exposure" in names and init_from_exif:
            self.color.init_from_exif()

    def trial_state(self) -> dict[str, Any]:
        """State that the parameters do not hold, for `load_trial_state`."""
        return {"last_error_reduction": self.last_error_reduction, "enabled_at": self.enabled_at}

    def load_trial_state(self, state: dict[str, Any]) -> None:
        """Restores the enabled corrections of a checkpoint."""
        self.last_error_reduction = dict(state["last_error_reduction"])
        for name, progress in state["enabled_at"].items():
            self.enable(progress, name)

    @property
    def is_finite(self) -> bool:
        """Whether all parameters are finite; after divergence some are not."""
        return all(bool(tensor.isfinite().all()) for tensor in self.state_dict().values())

    def param_groups(self) -> list[dict[str, Any]]:
        """Parameter groups of all possible corrections, each with its learning rate."""
        rates = self.learning_rates
        return [{"name": name, "params": self.group_parameters(name), "lr": lr} for name, lr in rates.items()]

    def lr_factors(self, progress: float) -> dict[str, float]:
        """Learning-rate factors of the groups: 0 until enabled, then from 1 down."""
        factors = dict.fromkeys(self.learning_rates, 0.0)
        for name, start in self.enabled_at.items():
            if progress >= start:
                boost = self._pose_lr_boost(progress - start) if name == "poses" else 1.0
                factors[name] = boost * LR_FINAL_FACTOR ** ((progress - start) / (1 - start))
        return factors

    def _pose_lr_boost(self, elapsed: float) -> float:
        """Learning-rate factor of poses, `elapsed` progress after they were enabled."""
        if elapsed < BOOST_PROGRESS:
            return POSE_LR_BOOST
        motion_px = float(self.poses.pose_adjustment.detach().square().sum(1).mean().sqrt())  # in pixels
        return min(POSE_LR_BOOST, max(1.0, motion_px / BOOST_MOTION_PX))

    def delay_growth(self, progress: float, growth_end: float) -> float:
        """Progress by which a field grows: slower during pose refinement, as fine detail would hold cameras where they are."""
        start = self.enabled_at.get("poses", 1.0)
        if not start < growth_end or progress < start:
            return progress
        return min(progress, start + (growth_end - start) * (progress - start) / GROWTH_DELAY_PROGRESS)

    def make_held_out_corrections(self, cameras: Cameras, bounds: Bounds) -> "Corrections":
        """Makes the same kinds of corrections for held-out cameras: the same lens, own poses and gains."""
        poses, exposure = ("poses" in self.enabled_at), ("exposure" in self.enabled_at)
        other = Corrections(cameras, bounds, poses=poses, exposure=exposure, fix_gauge=False)
        other.poses.copy_lens(self.poses)
        other.color.copy_lens(self.color)
        return other
