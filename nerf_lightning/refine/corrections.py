"""Corrections of the training photos' cameras and colours, and when in training each begins."""

from collections.abc import Sequence
from typing import Any

import torch

from nerf_lightning.cameras import Bounds, Cameras
from nerf_lightning.errors import InputError
from nerf_lightning.refine.color_correction import ColorCorrection
from nerf_lightning.refine.pose_refinement import PoseRefinement
from nerf_lightning.utils.options import Positive

START = 0.02
"""Share of the training before which nothing is corrected: photos cannot fit a field that shows nothing yet."""
LR_FINAL_FACTOR = 0.1
"""Factor on the learning rates at the end."""
FIRST_TRIAL_STEP, TRIAL_GROWTH, LAST_TRIAL = 24, 2, 0.4
"""Of the trials of `auto`: the step of the first, the factor from one to the next, and the share of the training that they end
with. Large faults show while the field is smooth, as later it has explained them by fog; small ones when it is sharp."""
EARLY_STEPS, EARLY_FACTOR = 64, 2
"""Steps before which gains are not tried, as a field that is still too dark everywhere wants gains; and how many times as much
poses have to explain before: a field that is still blurred follows any motion a little."""
FAST_SHARE, FAR_PX, FAST_FACTOR = 0.1, 4.0, 3.0
"""Poses move `FAST_FACTOR` times as fast for a first share of the training, and then where they have moved far: with the root
mean square of how far the content has moved in the photos, above `FAR_PX`. What is far off would else not arrive."""
MIN_GAIN = {"poses": 0.01, "light": 0.05}
"""Share by which most photos' squared error has to fall. Exact poses raise it; gains explain a little of all that is wrong, and
make the neutral look another than that of the photos."""
GROWTH_DELAY = 0.4
"""Share of the training that it takes, once poses are corrected, until the field has grown."""


class Corrections(torch.nn.Module):
    """Pose refinement and color correction of the training photos.

    Args:
        cameras: of the V photos, as given.
        bounds: of the content.
        exposures: see `ColorCorrection`. Gains start from them; with `auto` only if that lowers the error.
        poses: whether cameras turn and move.
        light: whether photos have gains.
        focal: whether, with poses, the focal length that all photos share is corrected.
        affine, vignetting: with light, see `ColorCorrection`.
        pose_rate: learning rate of poses, in pixels that the content moves a step.
        light_rate: learning rate of the gains' logarithms.
        auto: whether each is corrected from the first trial on that shows that it helps, and else not.
        fixed_gauge: whether what all photos have in common stays as it is; photos of a field that is already there have their
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
        light: bool = True,
        focal: bool = False,
        affine: bool = False,
        vignetting: bool = False,
        pose_rate: Positive = 0.1,
        light_rate: Positive = 0.003,
        auto: bool = False,
        fixed_gauge: bool = True,
    ):
        super().__init__()
        if not (poses or light):
            raise InputError("refine.poses", "", "false, with refine.light=false", "one of them", "or give refine=null")
        parts = {"focal": (focal, poses, "poses"), "affine": (affine, light, "light")}
        parts["vignetting"] = vignetting, light, "light"
        for name, (is_asked, is_possible, needed) in parts.items():
            if is_asked and not is_possible:
                found, todo = f"true, with refine.{needed}=false", f"or give refine.{needed}=true"
                raise InputError(f"refine.{name}", "", found, "false", todo)
        self.poses = PoseRefinement(cameras, bounds, focal, fixed_gauge)
        self.color = ColorCorrection(cameras, exposures, affine, vignetting, fixed_gauge)
        self.rates = {"poses": pose_rate} if poses else {}
        self.rates |= {"light": light_rate} if light else {}
        self.auto = auto
        self.num_trials = 0
        """So far, or that were missed."""
        self.last_gain: dict[str, float] = {}
        """What the last of them said, see `decide`."""
        self.enabled_at: dict[str, float] = {}
        """What is corrected, and from which progress on."""
        if not auto:
            self.enable(START, *self.rates)
            if light:
                self.color.use_stated()

    def parts(self, name: str) -> list[torch.nn.Parameter]:
        """What is learned of "poses", or of "light"."""
        return list((self.poses if name == "poses" else self.color).parameters())

    def enable(self, progress: float, *names: str) -> None:
        """Corrects poses or light from now on."""
        for name in names:
            self.enabled_at[name] = progress
            for parameter in self.parts(name):
                parameter.requires_grad_(True)

    def enable_poses_at_once(self) -> None:
        """Corrects poses, if they may be, from the first step on, as they are certainly wrong: they have far to go, and a field
        that explains them by fog would let no trial tell."""
        if "poses" in self.rates and "poses" not in self.enabled_at:
            self.enable(0.0, "poses")

    # Trials of `auto`

    def is_trial_due(self, step: int, progress: float) -> bool:
        """Whether to try what is not corrected yet."""
        is_time = progress <= LAST_TRIAL and step >= FIRST_TRIAL_STEP * TRIAL_GROWTH**self.num_trials
        return self.auto and is_time and bool(self.list_candidates(step))

    def list_candidates(self, step: int) -> list[str]:
        """What a trial at this step decides on."""
        return [name for name in self.rates if name not in self.enabled_at and (name != "light" or step >= EARLY_STEPS)]

    def choose(self, step: int, gains: dict[str, float], share: float = 1.0) -> list[str]:
        """What helps by trials at this step that said this; or might, as it explains this share of what it has to."""
        factor = share * (EARLY_FACTOR if step < EARLY_STEPS else 1)
        return [name for name in self.list_candidates(step) if gains[name] > factor * MIN_GAIN[name]]

    def decide(self, step: int, progress: float, gains: dict[str, float]) -> None:
        """Takes in what a trial said: by what share the squared error would fall if poses, or light, were corrected, or the
        stated exposures were taken for gains."""
        while step >= FIRST_TRIAL_STEP * TRIAL_GROWTH**self.num_trials:
            self.num_trials += 1
        chosen = self.choose(step, gains)
        self.last_gain |= {name: gains[name] for name in self.list_candidates(step)}
        self.enable(progress, *chosen)
        if "light" in chosen and gains["stated"] > 0:
            self.color.use_stated()

    def trial_state(self) -> dict[str, Any]:
        """What the parameters do not say, for `load_trial_state`."""
        return {"num_trials": self.num_trials, "last_gain": self.last_gain, "enabled_at": self.enabled_at}

    def load_trial_state(self, state: dict[str, Any]) -> None:
        """Goes on as decided before."""
        self.num_trials, self.last_gain = state["num_trials"], dict(state["last_gain"])
        for name, progress in state["enabled_at"].items():
            self.enable(progress, name)

    # Training

    @property
    def is_finite(self) -> bool:
        """Whether all of it are finite numbers: some are not any more where training has broken down."""
        return all(bool(tensor.isfinite().all()) for tensor in self.state_dict().values())

    def param_groups(self) -> list[dict[str, Any]]:
        """The optimiser's groups: what is or may be corrected, each with its learning rate."""
        return [{"name": name, "params": self.parts(name), "lr": rate} for name, rate in self.rates.items()]

    def lr_factors(self, progress: float) -> dict[str, float]:
        """Factors on the rates of these groups, by progress in training: nothing at first, then from 1 down."""
        factors = {}
        for name in self.rates:
            start = self.enabled_at.get(name, 1.0)
            if name not in self.enabled_at or progress < start:
                factors[name] = 0.0
                continue
            pace = self._pose_pace(progress - start) if name == "poses" else 1.0
            factors[name] = pace * LR_FINAL_FACTOR ** ((progress - start) / (1 - start))
        return factors

    def _pose_pace(self, passed: float) -> float:
        """Factor on the rate of poses, by how far they have moved since a share of the training ago."""
        if passed < FAST_SHARE:
            return FAST_FACTOR
        moved = float(self.poses.motions.detach().square().sum(1).mean().sqrt())  # in pixels
        return min(FAST_FACTOR, max(1.0, moved / FAR_PX))

    def delay_growth(self, progress: float, growth_end: float) -> float:
        """The progress by which a field grows: slower while cameras find their places, as detail would hold them where they
        are."""
        start = self.enabled_at.get("poses", 1.0)
        if not start < growth_end or progress < start:
            return progress
        return min(progress, start + (growth_end - start) * (progress - start) / GROWTH_DELAY)

    def for_held_out(self, cameras: Cameras, bounds: Bounds) -> "Corrections":
        """Corrections of the same kinds for other photos of the field that was trained with these: by the same lens, and with
        gains alone."""
        poses, light = ("poses" in self.enabled_at), ("light" in self.enabled_at)
        other = Corrections(cameras, bounds, poses=poses, light=light, fixed_gauge=False)
        other.poses.share_lens(self.poses)
        other.color.share_lens(self.color)
        return other
