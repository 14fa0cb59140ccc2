"""Corrections of the training photos' cameras and colours, and how fast each is learned."""

from collections.abc import Sequence
from typing import Any

import torch

from nerf_lightning.cameras import Bounds, Cameras
from nerf_lightning.errors import InputError
from nerf_lightning.refine.color_correction import ColorCorrection
from nerf_lightning.refine.pose_refinement import PoseRefinement
from nerf_lightning.utils.option_checks import PositiveFloat

START_PROGRESS = 0.02
"""Share of the training before which nothing is corrected: photos cannot fit a field that shows nothing yet."""
LR_FINAL_FACTOR = 0.1
"""Factor on the learning rates at the end."""
BOOST_PROGRESS, BOOST_MOTION_PX, POSE_LR_BOOST = 0.1, 4.0, 3.0
"""Poses move `POSE_LR_BOOST` times as fast for a first share of the training, and then where they have moved far: with the root
mean square of how far the content has moved in the photos, above `BOOST_MOTION_PX`. What is far off would else not arrive."""
GROWTH_DELAY_PROGRESS = 0.4
"""Share of the training that it takes, once poses are corrected, until the field has grown."""
REQUIRED_CORRECTION = {"focal": "poses", "affine": "exposure", "vignetting": "exposure"}
"""What is a part of what."""


class Corrections(torch.nn.Module):
    """Pose refinement and color correction of the training photos.

    Args:
        cameras: of the V photos, as given.
        bounds: of the content.
        exposures: see `ColorCorrection`. Gains start from them; with `auto` only if that lowers the error.
        poses: whether cameras turn and move.
        exposure: whether photos have gains.
        focal: whether, with poses, the focal length that all photos share is corrected.
        affine, vignetting: with exposure, see `ColorCorrection`.
        pose_lr: learning rate of poses, in pixels that the content moves a step.
        exposure_lr: learning rate of the gains' logarithms.
        auto: whether each is corrected from the first trial on that shows that it helps, and else not.
        fix_gauge: whether what all photos have in common stays as it is; photos of a field that is already there have their
            own.

    Raises:
        InputError: where neither is to be corrected, and for a part of what is not.
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
            raise InputError(
                "refine.poses", "", "false, with refine.exposure=false", "one of them", "or give refine=null"
            )
        for part, is_asked in {"focal": focal, "affine": affine, "vignetting": vignetting}.items():
            if is_asked and (required := REQUIRED_CORRECTION[part]) not in self.learning_rates:
                found, hint = f"true, with refine.{required}=false", f"or give refine.{required}=true"
                raise InputError(f"refine.{part}", "", found, "false", hint)
        self.poses = PoseRefinement(cameras, bounds, focal, fix_gauge)
        self.color = ColorCorrection(cameras, exposures, affine, vignetting, fix_gauge)
        self.auto = auto
        self.last_error_reduction: dict[str, float] = {}
        """Share of the squared error that the last trial of `auto` explained, by what it was about."""
        self.enabled_at: dict[str, float] = {}
        """What is corrected, and from which progress on."""
        if not auto:
            self.enable(START_PROGRESS, *self.learning_rates)
            if exposure:
                self.color.init_from_exif()

    def group_parameters(self, name: str) -> list[torch.nn.Parameter]:
        """What is learned of "poses", or of "exposure"."""
        return list((self.poses if name == "poses" else self.color).parameters())

    def enable(self, progress: float, *names: str) -> None:
        """Corrects poses or light from now on."""
        for name in names:
            self.enabled_at[name] = progress
            for parameter in self.group_parameters(name):
                parameter.requires_grad_(True)

    def enable_poses(self) -> None:
        """Corrects poses, if they may be, from the first step on, as they are certainly wrong: they have far to go, and a field
        that explains them by fog would let no trial tell."""
        if "poses" in self.learning_rates and "poses" not in self.enabled_at:
            self.enable(0.0, "poses")

    def record_trial(
        self, progress: float, names: Sequence[str], error_reductions: dict[str, float], init_from_exif: bool
    ) -> None:
        """Takes in a trial of `auto`.

        Args:
            progress: of the training.
            names: what helps, to be corrected from now on.
            error_reductions: see `last_error_reduction`.
            init_from_exif: whether gains, if they help, start from the stated exposures.
        """
        self.last_error_reduction |= error_reductions
        self.enable(progress, *names)
        if "exposure" in names and init_from_exif:
            self.color.init_from_exif()

    def trial_state(self) -> dict[str, Any]:
        """What the parameters do not say, for `load_trial_state`."""
        return {"last_error_reduction": self.last_error_reduction, "enabled_at": self.enabled_at}

    def load_trial_state(self, state: dict[str, Any]) -> None:
        """Goes on as decided before."""
        self.last_error_reduction = dict(state["last_error_reduction"])
        for name, progress in state["enabled_at"].items():
            self.enable(progress, name)

    @property
    def is_finite(self) -> bool:
        """Whether all of it are finite numbers: some are not any more where training has broken down."""
        return all(bool(tensor.isfinite().all()) for tensor in self.state_dict().values())

    def param_groups(self) -> list[dict[str, Any]]:
        """The optimiser's groups: what is or may be corrected, each with its learning rate."""
        return [
            {"name": name, "params": self.group_parameters(name), "lr": rate}
            for name, rate in self.learning_rates.items()
        ]

    def lr_factors(self, progress: float) -> dict[str, float]:
        """Factors on the rates of these groups, by progress in training: nothing at first, then from 1 down."""
        factors = dict.fromkeys(self.learning_rates, 0.0)
        for name, start in self.enabled_at.items():
            if progress >= start:
                boost = self._pose_lr_boost(progress - start) if name == "poses" else 1.0
                factors[name] = boost * LR_FINAL_FACTOR ** ((progress - start) / (1 - start))
        return factors

    def _pose_lr_boost(self, elapsed: float) -> float:
        """Factor on the rate of poses, by how far they have moved since a share of the training ago."""
        if elapsed < BOOST_PROGRESS:
            return POSE_LR_BOOST
        motion_px = float(self.poses.pose_adjustment.detach().square().sum(1).mean().sqrt())  # in pixels
        return min(POSE_LR_BOOST, max(1.0, motion_px / BOOST_MOTION_PX))

    def delay_growth(self, progress: float, growth_end: float) -> float:
        """The progress by which a field grows: slower while cameras find their places, as detail would hold them where they
        are."""
        start = self.enabled_at.get("poses", 1.0)
        if not start < growth_end or progress < start:
            return progress
        return min(progress, start + (growth_end - start) * (progress - start) / GROWTH_DELAY_PROGRESS)

    def make_held_out_corrections(self, cameras: Cameras, bounds: Bounds) -> "Corrections":
        """Corrections of the same kinds for other photos of the field that was trained with these: by the same lens, and with
        gains alone."""
        poses, exposure = ("poses" in self.enabled_at), ("exposure" in self.enabled_at)
        other = Corrections(cameras, bounds, poses=poses, exposure=exposure, fix_gauge=False)
        other.poses.copy_lens(self.poses)
        other.color.copy_lens(self.color)
        return other
