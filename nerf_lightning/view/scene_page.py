"""A scene as a page in the browser, served by Viser: cameras with their photos, points, and what to show."""

from nerf_lightning.dataset.scene import Scene
from nerf_lightning.drawing.ink import GREY, MAUVE, VERMILLION, rgb
from nerf_lightning.view.drawing import box_edges, colour_points, home_of, overview, path_segments
from nerf_lightning.view.page import Page


class ScenePage(Page):
    """Serves a scene until `stop`.

    Args:
        scene: what is shown.
        host, port: see `Page`.
    """

    def __init__(self, scene: Scene, host: str, port: int):
        _, distance = home_of(scene.orbit)
        super().__init__(scene.name, overview(scene), distance, host, port)
        self.scene = scene
        with self.server.atomic():
            self.set_stage()
            self.add_cameras(scene)
            self._add_surroundings()
            self._add_controls()

    def _add_surroundings(self) -> None:
        scene = self.server.scene
        if self.scene.points is not None:
            self.points("/points", *colour_points(self.scene.points, self.scene.train), 0.006)
        self.lines("/orbit", path_segments(self.scene.orbit), rgb(MAUVE))
        self.lines("/box", box_edges(self.scene.bounds.aabb), rgb(GREY))
        self.points("/focus", self.home.look_at[None], rgb(VERMILLION), 0.02)
        scene.add_frame("/axes", axes_length=0.2 * self.scale, axes_radius=0.003 * self.scale)

    def _add_controls(self) -> None:
        gui = self.server.gui
        counts = f"{len(self.scene.train)} training cameras (blue), {len(self.scene.val)} held out (orange)"
        width, height = self.scene.resolution
        gui.add_markdown(
            f"{counts}, {width} x {height} pixels. Drag to turn, scroll to zoom; click a camera to look through it."
        )
        gui.add_button("whole scene").on_click(self.go_home)
        with gui.add_folder("show"):
            for word in ("points", "orbit", "box", "axes"):
                self.switch(word, self.server.scene.get_handle_by_name(f"/{word}"))
            self.add_camera_switches()
