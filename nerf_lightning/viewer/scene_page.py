"""A scene as a page in the browser, served by Viser: cameras with their photos, rays and samples, and what to show."""

import contextlib
import io
import math
import threading
from collections.abc import Callable

import numpy as np
import torch
import viser
from viser.transforms import SO3

from nerf_lightning.dataset.scene import Scene
from nerf_lightning.scene_drawing import (
    Frustum,
    Viewpoint,
    box_edges,
    frusta,
    one_ray_each,
    overview,
    path_segments,
    ray_figure,
    rays_of_one,
    scene_scale,
    through,
)

TRAINING, HELD_OUT, ORBIT, BOX = (31, 119, 180), (255, 127, 14), (148, 103, 189), (110, 110, 110)
APPROACH, INSIDE, SAMPLES, FOCUS = (190, 190, 190), (44, 160, 44), (0, 70, 0), (214, 39, 40)
LINE = 1.5
"""Width of lines, screen pixels."""
FRUSTUM_DEPTH = 0.12
"""Depth of a frustum at first, as a share of the cameras' distance to what they look at."""
ONE_EACH, MANY, NO_RAYS = "one ray a frustum", "many rays of one frustum", "none"


class _Server(viser.ViserServer):
    """A server whose pages cannot ask for a tunnel to the internet."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


class ScenePage:
    """Serves a scene from a thread of its own until `stop`.

    Args:
        scene: what is shown.
        host: address to listen on.
        port: where to listen; the next free one where it is taken.
        photo_side: longest side of the photos on the frusta, pixels.
        rays: how many rays of one frustum.
        samples: samples on each ray that meets the bounds.
    """

    def __init__(self, scene: Scene, host: str, port: int, photo_side: int, rays: int, samples: int):
        self.scene = scene
        self.rays = rays
        self.samples = samples
        self.scale = scene_scale(scene)
        self.home = overview(scene)
        self.draw = 0
        """Number of the draw of pixels: its seed."""
        self.redrawing = threading.Lock()  # callbacks come from many threads
        with _hushed():
            self.server = _Server(host, port, verbose=False)
        with self.server.atomic():
            self._set_stage()
            self._add_cameras(photo_side)
            self._add_surroundings()
            self._add_controls()
            self.draw_rays()

    @property
    def port(self) -> int:
        return self.server.get_port()

    def stop(self) -> None:
        with _hushed():
            self.server.stop()

    def _set_stage(self) -> None:
        """Light, sizes and the first look; nothing that a browser would fetch from elsewhere."""
        scene, gui, camera = self.server.scene, self.server.gui, self.server.initial_camera
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.set_panel_label(self.scene.name)
        scene.configure_environment_map(None)
        scene.configure_default_lights(cast_shadow=False)
        scene.set_up_direction(self.home.up.astype(np.float64))
        camera.near, camera.far = 2e-3 * self.scale, 1e3 * self.scale
        camera.position, camera.look_at, camera.fov = self.home.position, self.home.look_at, self.home.fov

        @self.server.on_client_connect
        def allow_any_scale(client: viser.ClientHandle) -> None:
            client.camera.max_orbit_distance = max(1e4, 1e3 * self.scale)
            client.camera.min_orbit_distance = min(1e-2, 1e-3 * self.scale)

    def _add_cameras(self, photo_side: int) -> None:
        """Frusta and their names, in a group for each split, so that a group is shown and hidden as one."""
        scene = self.server.scene
        self.groups: dict[str, viser.FrameHandle] = {}
        self.names: list[viser.FrameHandle] = []
        self.pyramids: list[tuple[Frustum, viser.CameraFrustumHandle]] = []
        splits = (("training", self.scene.train, TRAINING), ("held out", self.scene.val, HELD_OUT))
        for word, views, colour in splits:
            group = word.replace(" ", "_")
            self.groups[word] = scene.add_frame(f"/{group}", show_axes=False)
            self.names.append(scene.add_frame(f"/{group}/names", show_axes=False, visible=False))
            for i, frustum in enumerate(frusta(views, word, photo_side)):
                wxyz = SO3.from_matrix(frustum.c2w[:3, :3].astype(np.float64)).wxyz
                position = frustum.c2w[:3, 3]
                handle = scene.add_camera_frustum(
                    f"/{group}/{i}",
                    frustum.fov,
                    frustum.aspect,
                    scale=viser_scale(frustum, FRUSTUM_DEPTH * self.scale),
                    thickness=LINE,
                    thickness_units="screen",
                    color=colour,
                    image=frustum.photo,
                    wxyz=wxyz,
                    position=position,
                    cast_shadow=False,
                    receive_shadow=False,
                )
                handle.on_click(self._visit(frustum, i if word == "training" else None))
                self.pyramids.append((frustum, handle))
                scene.add_label(f"/{group}/names/{i}", frustum.name, position=position, font_screen_scale=0.8)

    def _visit(self, frustum: Frustum, view: int | None) -> Callable[[viser.SceneNodePointerEvent], None]:
        """What a click on a frustum does: the browser's camera goes there, and its rays are the ones on show."""

        def visit(event: viser.SceneNodePointerEvent) -> None:
            look_from(event.client, through(frustum, self.scale, self.home.up))
            if view is not None:
                self.camera.value = view  # type: ignore[misc]  # settable, whatever its annotations say

        return visit

    def _add_surroundings(self) -> None:
        scene = self.server.scene
        self._lines("/orbit", path_segments(self.scene.orbit), ORBIT)
        self._lines("/box", box_edges(self.scene.bounds.aabb), BOX)
        self._points("/focus", self.home.look_at[None], FOCUS, 0.02)
        scene.add_frame("/axes", axes_length=0.2 * self.scale, axes_radius=0.003 * self.scale)
        self.ray_group = scene.add_frame("/rays", show_axes=False)

    def _add_controls(self) -> None:
        gui = self.server.gui
        counts = f"{len(self.scene.train)} training cameras (blue), {len(self.scene.val)} held out (orange)"
        width, height = self.scene.resolution
        gui.add_markdown(f"{counts}, {width} x {height} pixels. Click a frustum to look through it.")
        gui.add_button("whole scene").on_click(self._go_home)
        with gui.add_folder("show"):
            for word, group in self.groups.items():
                self._switch(word, group)
            for word in ("orbit", "box", "axes"):
                self._switch(word, self.server.scene.get_handle_by_name(f"/{word}"))
            self._switch("names", *self.names)
            self.photos = gui.add_checkbox("photos", True)
            self.photos.on_update(lambda _: self.show_photos())
            self.depth = gui.add_slider("frustum size", 0.01, 0.5, 0.01, FRUSTUM_DEPTH)
            self.depth.on_update(lambda _: self.size_frusta())
        with gui.add_folder("rays"):
            self.which = gui.add_dropdown("rays", (ONE_EACH, MANY, NO_RAYS))
            self.camera = gui.add_slider(
                "frustum", 0, len(self.scene.train) - 1, 1, 0, hint="whose rays: a training view"
            )
            self.jitter = gui.add_checkbox("jitter", False, hint="stratified samples, as in training")
            for control in (self.which, self.camera, self.jitter):
                control.on_update(lambda _: self.draw_rays())
            gui.add_button("draw again", hint="other random pixels").on_click(lambda _: self.draw_rays(again=True))

    def _switch(self, word: str, *handles: viser.SceneNodeHandle | None) -> None:
        """A checkbox that shows and hides scene nodes; none where there is nothing to show."""
        present = [handle for handle in handles if handle is not None]
        if not present:
            return
        box = self.server.gui.add_checkbox(word, present[0].visible)

        def show(_: viser.GuiEvent) -> None:
            for handle in present:
                handle.visible = box.value

        box.on_update(show)

    def _go_home(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            look_from(event.client, self.home)

    def show_photos(self) -> None:
        with self.server.atomic():
            for frustum, handle in self.pyramids:
                handle.image = frustum.photo if self.photos.value else None

    def size_frusta(self) -> None:
        with self.server.atomic():
            for frustum, handle in self.pyramids:
                handle.scale = viser_scale(frustum, self.depth.value * self.scale)

    def draw_rays(self, again: bool = False) -> None:
        """Draws the rays that the controls ask for; the same pixels as before unless `again`."""
        with self.redrawing, self.server.atomic():
            self.draw += again
            generator = torch.Generator().manual_seed(self.draw)
            cameras = self.scene.train.cameras
            self.ray_group.visible = self.which.value != NO_RAYS
            if self.which.value == MANY:
                rays = rays_of_one(cameras, self.camera.value, self.rays, generator)
            else:
                rays = one_ray_each(cameras, generator)
            jitter = generator if self.jitter.value else None
            figure = ray_figure(rays, self.scene.bounds, self.samples, self.scale, jitter)
            self._lines("/rays/approach", figure.approach, APPROACH)
            self._lines("/rays/inside", figure.inside, INSIDE)
            self._points("/rays/samples", figure.samples, SAMPLES, 0.006)

    def _lines(self, name: str, segments: np.ndarray, colour: tuple[int, int, int]) -> None:
        """Line segments [N, 2, 3] under a name, in place of what it had."""
        if not len(segments):
            self.server.scene.remove_by_name(name)
            return
        self.server.scene.add_line_segments(name, segments, colour, thickness=LINE, thickness_units="screen")

    def _points(self, name: str, points: np.ndarray, colour: tuple[int, int, int], size: float) -> None:
        """Points [N, 3] under a name, in place of what it had; their size is a share of the scene's scale."""
        if not len(points):
            self.server.scene.remove_by_name(name)
            return
        self.server.scene.add_point_cloud(
            name, points, colour, point_size=size * self.scale, point_shape="circle", precision="float32"
        )


def viser_scale(frustum: Frustum, depth: float) -> float:
    """The scale at which Viser draws a frustum `depth` deep: it sizes frusta by their volume, d^3 tan^2(fov/2) aspect / 3."""
    return depth * math.cbrt(math.tan(frustum.fov / 2) ** 2 * frustum.aspect / 3)


def look_from(client: viser.ClientHandle, viewpoint: Viewpoint) -> None:
    """Puts a browser's camera somewhere, at once."""
    with client.atomic():
        client.camera.up_direction = viewpoint.up
        client.camera.position = viewpoint.position
        client.camera.look_at = viewpoint.look_at
        client.camera.fov = viewpoint.fov


def _hushed() -> contextlib.AbstractContextManager[object]:
    """Viser announces its start and stop whatever it is told; the verb has a line of its own."""
    return contextlib.redirect_stdout(io.StringIO())
