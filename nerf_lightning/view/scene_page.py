"""Viewer page of a scene: cameras with photos, points, bounds, rays and samples."""

import torch

from nerf_lightning.dataset.scene import Scene
from nerf_lightning.drawing.style import GRAY, GREEN, MAUVE, SKY, VERMILLION, parse_hex_color
from nerf_lightning.view import geometry
from nerf_lightning.view.page import Page


class ScenePage(Page):
    """Serves a scene until `stop`.

    Args:
        scene: the scene to show.
        host, port: see `Page`.
    """

    def __init__(self, scene: Scene, host: str, port: int):
        _, distance = geometry.get_home_viewpoint(scene.orbit)
        super().__init__(scene.name, geometry.get_overview_viewpoint(scene), distance, host, port)
        self.scene = scene
        self.seed = 0
        """Seed of the random pixels."""
        with self.server.atomic():
            self.set_up_scene()
            self.add_cameras(scene)
            self._add_geometry()
            self._add_controls()
            self.draw_rays()

    def _add_geometry(self) -> None:
        scene = self.server.scene
        if self.scene.points is not None:
            self.points("/points", *geometry.color_points(self.scene.points, self.scene.train), 0.006)
        self.draw_lines("/orbit", geometry.compute_path_segments(self.scene.orbit), parse_hex_color(MAUVE))
        self.draw_lines("/box", geometry.compute_box_edges(self.scene.bounds.aabb), parse_hex_color(GRAY))
        self.points("/focus", self.home.look_at[None], parse_hex_color(VERMILLION), 0.02)
        scene.add_frame("/axes", axes_length=0.2 * self.scale, axes_radius=0.003 * self.scale)
        self.ray_group = scene.add_frame("/rays", show_axes=False)

    def _add_controls(self) -> None:
        gui = self.server.gui
        counts = f"{len(self.scene.train)} training cameras (blue), {len(self.scene.val)} held out (orange)"
        size = "{} x {} pixels".format(*self.scene.resolution)
        gui.add_markdown(f"{counts}, {size}. Drag to turn, scroll to zoom; click a camera to look through it.")
        gui.add_button("whole scene").on_click(self.go_home)
        with gui.add_folder("show"):
            for word in ("points", "orbit", "box", "axes"):
                self.add_checkbox(word, self.server.scene.get_handle_by_name(f"/{word}"))
            self.add_camera_checkboxes()
        with gui.add_folder("rays", expand_by_default=False):
            self.rays = gui.add_slider("rays", 0, 64, 1, 0, hint="from each training camera")
            self.samples = gui.add_slider("samples", 1, 256, 1, 64, hint="on each ray")
            for control in (self.rays, self.samples):
                control.on_update(lambda _: self.draw_rays())
            button = gui.add_button("other rays", hint="through new random pixels")
            button.on_click(lambda _: self.draw_rays(again=True))

    def draw_rays(self, again: bool = False) -> None:
        """Draws rays as set by the controls; through new random pixels if `again`."""
        with self.draw_lock, self.server.atomic():
            self.seed += again
            self.ray_group.visible = self.rays.value > 0
            if not self.ray_group.visible:
                return
            cameras = self.scene.train.cameras
            views = torch.arange(len(cameras)).repeat_interleave(self.rays.value)
            rays = geometry.sample_random_rays(cameras, views, torch.Generator().manual_seed(self.seed))
            figure = geometry.build_ray_figure(rays, self.scene.bounds, self.samples.value, self.scale)
            self.draw_lines("/rays/approach", figure.approach, parse_hex_color(SKY))
            self.draw_lines("/rays/inside", figure.inside, parse_hex_color(GREEN))
            self.points("/rays/samples", figure.samples, parse_hex_color(VERMILLION), 0.006)
