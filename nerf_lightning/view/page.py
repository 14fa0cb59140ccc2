"""Base of the viewer pages: lights, camera frusta with photos, lines, points and checkboxes."""

import contextlib
import io
import logging
import math
import threading
from collections.abc import Callable

import numpy as np
import viser
from viser.transforms import SO3

from nerf_lightning.dataset.scene import Scene
from nerf_lightning.drawing.style import BLUE, ORANGE, parse_hex_color
from nerf_lightning.view.geometry import Frustum, Viewpoint, get_photo_viewpoint, iterate_frusta

SPLIT_COLORS = {"training": parse_hex_color(BLUE), "held out": parse_hex_color(ORANGE)}
"""Frustum colors by split."""
MAX_PHOTO_SIDE = 160
"""Longest side of photos on frusta, pixels."""
LINE_WIDTH = 1.5
"""Line width, screen pixels."""
FRUSTUM_DEPTH_FRACTION = 0.12
"""Default depth of a frustum, relative to the page's scale."""


class Page:
    """Serves a page from a background thread until `stop`.

    Args:
        name: title.
        home: first view.
        scale: cameras' distance to the focus, world units; sizes are relative to it.
        host: address to listen on.
        port: the next free one if taken.
    """

    def __init__(self, name: str, home: Viewpoint, scale: float, host: str, port: int):
        self.name = name
        self.home = home
        self.scale = scale
        self.draw_lock = threading.Lock()  # callbacks come from many threads
        self.groups: dict[str, viser.FrameHandle] = {}
        self.names: list[viser.FrameHandle] = []
        self.frusta: list[tuple[Frustum, viser.CameraFrustumHandle]] = []
        logging.getLogger("websockets").setLevel(logging.WARNING)
        with _silence_stdout():
            self.server = viser.ViserServer(host, port, verbose=False)

    @property
    def port(self) -> int:
        return self.server.get_port()

    def run(self) -> None:
        """Blocks for ever; the server runs in background threads."""
        threading.Event().wait()

    def stop(self) -> None:
        with _silence_stdout():
            self.server.stop()

    def set_up_scene(self) -> None:
        """Sets lights, sizes and the first view; disables content that browsers would download."""
        scene, gui, camera = self.server.scene, self.server.gui, self.server.initial_camera
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.set_panel_label(self.name)
        scene.configure_environment_map(None)
        scene.configure_default_lights(cast_shadow=False)
        scene.set_up_direction(self.home.up.astype(np.float64))
        camera.near, camera.far = 2e-3 * self.scale, 1e3 * self.scale
        camera.position, camera.look_at, camera.fov = self.home.position, self.home.look_at, self.home.fov

        @self.server.on_client_connect
        def allow_any_scale(client: viser.ClientHandle) -> None:
            client.camera.max_orbit_distance = max(1e4, 1e3 * self.scale)
            client.camera.min_orbit_distance = min(1e-2, 1e-3 * self.scale)

    def add_cameras(self, shown: Scene, visible: bool = True) -> None:
        """Adds frusta and their names, one group per split."""
        scene = self.server.scene
        for word, views in (("training", shown.train), ("held out", shown.val)):
            group = word.replace(" ", "_")
            self.groups[word] = scene.add_frame(f"/{group}", show_axes=False, visible=visible)
            self.names.append(scene.add_frame(f"/{group}/names", show_axes=False, visible=False))
            for i, frustum in enumerate(iterate_frusta(views, MAX_PHOTO_SIDE)):
                wxyz = SO3.from_matrix(frustum.c2w[:3, :3].astype(np.float64)).wxyz
                position = frustum.c2w[:3, 3]
                handle = scene.add_camera_frustum(
                    f"/{group}/{i}",
                    frustum.fov,
                    frustum.aspect,
                    scale=viser_scale(frustum, FRUSTUM_DEPTH_FRACTION * self.scale),
                    thickness=LINE_WIDTH,
                    thickness_units="screen",
                    color=SPLIT_COLORS[word],
                    image=frustum.photo,
                    wxyz=wxyz,
                    position=position,
                    cast_shadow=False,
                    receive_shadow=False,
                )
                handle.on_click(self._visit(frustum))
                self.frusta.append((frustum, handle))
                scene.add_label(f"/{group}/names/{i}", frustum.name, position=position, font_screen_scale=0.8)

    def _visit(self, frustum: Frustum) -> Callable[[viser.SceneNodePointerEvent], None]:
        """Click handler that moves the browser's camera to a frustum."""
        return lambda event: look_from(event.client, get_photo_viewpoint(frustum, self.scale, self.home.up))

    def add_camera_checkboxes(self) -> None:
        """Adds checkboxes for cameras, names and photos."""
        gui = self.server.gui
        for word, group in self.groups.items():
            self.add_checkbox(word, group)
        self.add_checkbox("names", *self.names)
        self.photos = gui.add_checkbox("photos", True)
        self.photos.on_update(lambda _: self.show_photos())
        self.depth = gui.add_slider("camera size", 0.01, 0.5, 0.01, FRUSTUM_DEPTH_FRACTION)
        self.depth.on_update(lambda _: self.size_frusta())

    def add_checkbox(self, word: str, *handles: viser.SceneNodeHandle | None) -> None:
        """Adds a checkbox for the visibility of scene nodes, if any exists."""
        present = [handle for handle in handles if handle is not None]
        if not present:
            return
        box = self.server.gui.add_checkbox(word, present[0].visible)

        def show(_: viser.GuiEvent) -> None:
            for handle in present:
                handle.visible = box.value

        box.on_update(show)

    def go_home(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            look_from(event.client, self.home)

    def show_photos(self) -> None:
        with self.server.atomic():
            for frustum, handle in self.frusta:
                handle.image = frustum.photo if self.photos.value else None

    def size_frusta(self) -> None:
        with self.server.atomic():
            for frustum, handle in self.frusta:
                handle.scale = viser_scale(frustum, self.depth.value * self.scale)

    def draw_lines(self, name: str, segments: np.ndarray, color: tuple[int, int, int]) -> None:
        """Draws line segments [N, 2, 3], replacing the node `name`."""
        if not len(segments):
            self.server.scene.remove_by_name(name)
            return
        self.server.scene.add_line_segments(name, segments, color, thickness=LINE_WIDTH, thickness_units="screen")

    def points(self, name: str, points: np.ndarray, color: tuple[int, int, int] | np.ndarray, size: float) -> None:
        """Draws points [N, 3] in one color or [N, 3], replacing the node `name`; `size` is relative to `scale`."""
        if not len(points):
            self.server.scene.remove_by_name(name)
            return
        self.server.scene.add_point_cloud(
            name, points, color, point_size=size * self.scale, point_shape="circle", precision="float32"
        )


def viser_scale(frustum: Frustum, depth: float) -> float:
    """Viser's scale of a frustum of a given depth: Viser sizes frusta by volume, d^3 tan^2(fov/2) aspect / 3."""
    return depth * math.cbrt(math.tan(frustum.fov / 2) ** 2 * frustum.aspect / 3)


def look_from(client: viser.ClientHandle, viewpoint: Viewpoint) -> None:
    """Moves a browser's camera to a viewpoint."""
    with client.atomic():
        client.camera.up_direction = viewpoint.up
        client.camera.position = viewpoint.position
        client.camera.look_at = viewpoint.look_at
        client.camera.fov = viewpoint.fov


def _silence_stdout() -> contextlib.AbstractContextManager[object]:
    """Suppresses Viser's start and stop messages."""
    return contextlib.redirect_stdout(io.StringIO())
