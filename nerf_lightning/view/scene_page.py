"""A scene as a page in the browser, served by Viser: cameras with their photos, rays and samples, and what to show."""

import torch

from nerf_lightning.dataset.scene import Scene
from nerf_lightning.view.drawing import (
    box_edges,
    overview,
    path_segments,
    random_rays,
    ray_figure,
    scene_scale,
)
from nerf_lightning.view.page import Page

ORBIT, BOX = (148, 103, 189), (110, 110, 110)
APPROACH, INSIDE, SAMPLES, FOCUS = (190, 190, 190), (44, 160, 44), (0, 70, 0), (214, 39, 40)
ONE_EACH, MANY, NO_RAYS = "one ray from each camera", "many rays from one camera", "none"


class ScenePage(Page):
    """Serves a scene until `stop`.

    Args:
        scene: what is shown.
        host: address to listen on.
        port: where to listen; the next free one if it is taken.
        photo_side: longest side of the photos on the frusta, pixels.
        rays: how many rays from one camera.
        samples: samples on each ray that meets the bounds.
    """

    def __init__(self, scene: Scene, host: str, port: int, photo_side: int, rays: int, samples: int):
        super().__init__(scene.name, overview(scene), scene_scale(scene), host, port)
        self.scene = scene
        self.rays = rays
        self.samples = samples
        self.draw = 0
        """Seed of the random pixels."""
        with self.server.atomic():
            self.set_stage()
            self.add_cameras(scene, photo_side)
            self._add_surroundings()
            self._add_controls()
            self.draw_rays()

    def visited(self, view: int) -> None:
        self.camera.value = view  # type: ignore[misc]  # settable, whatever its annotations say

    def _add_surroundings(self) -> None:
        scene = self.server.scene
        self.lines("/orbit", path_segments(self.scene.orbit), ORBIT)
        self.lines("/box", box_edges(self.scene.bounds.aabb), BOX)
        self.points("/focus", self.home.look_at[None], FOCUS, 0.02)
        scene.add_frame("/axes", axes_length=0.2 * self.scale, axes_radius=0.003 * self.scale)
        self.ray_group = scene.add_frame("/rays", show_axes=False)

    def _add_controls(self) -> None:
        gui = self.server.gui
        counts = f"{len(self.scene.train)} training cameras (blue), {len(self.scene.val)} held out (orange)"
        width, height = self.scene.resolution
        gui.add_markdown(f"{counts}, {width} x {height} pixels. Click a camera to look through it.")
        gui.add_button("whole scene").on_click(self.go_home)
        with gui.add_folder("show"):
            for word in ("orbit", "box", "axes"):
                self.switch(word, self.server.scene.get_handle_by_name(f"/{word}"))
            self.add_camera_switches()
        with gui.add_folder("rays"):
            self.which = gui.add_dropdown("rays", (ONE_EACH, MANY, NO_RAYS))
            self.camera = gui.add_slider("camera", 0, len(self.scene.train) - 1, 1, 0, hint="which training camera")
            self.jitter = gui.add_checkbox("jitter", False, hint="stratified samples, as in training")
            for control in (self.which, self.camera, self.jitter):
                control.on_update(lambda _: self.draw_rays())
            gui.add_button("other rays", hint="through new random pixels").on_click(
                lambda _: self.draw_rays(again=True)
            )

    def draw_rays(self, again: bool = False) -> None:
        """Draws the rays that the controls ask for; the same pixels as before unless `again`."""
        with self.redrawing, self.server.atomic():
            self.draw += again
            generator = torch.Generator().manual_seed(self.draw)
            cameras = self.scene.train.cameras
            self.ray_group.visible = self.which.value != NO_RAYS
            many = self.which.value == MANY
            views = torch.full((self.rays,), self.camera.value) if many else torch.arange(len(cameras))
            rays = random_rays(cameras, views, generator)
            jitter = generator if self.jitter.value else None
            figure = ray_figure(rays, self.scene.bounds, self.samples, self.scale, jitter)
            self.lines("/rays/approach", figure.approach, APPROACH)
            self.lines("/rays/inside", figure.inside, INSIDE)
            self.points("/rays/samples", figure.samples, SAMPLES, 0.006)
