"""Viewer page of a trained field, with its training cameras."""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import viser
from viser.transforms import SO3

from nerf_lightning.cameras import Cameras, Rays
from nerf_lightning.dataset import Scene
from nerf_lightning.drawing.channels import CHANNELS
from nerf_lightning.drawing.style import GRAY, GREEN, VERMILLION, parse_hex_color
from nerf_lightning.renderer.background import COLORS
from nerf_lightning.system import NeRF3D
from nerf_lightning.view.geometry import compute_box_edges, get_home_viewpoint
from nerf_lightning.view.page import Page
from nerf_lightning.view.progressive import ProgressiveRenderer, ViewRequest

FIRST_IMAGE_SECONDS = 0.08
"""Render time of the first image after a camera movement; it arrives within 0.2 s."""
REFINEMENT_FACTOR = 2
"""Factor on width and height of each further image while the camera rests."""
JPEG_QUALITY = 80
"""JPEG quality, 0 to 100."""


@dataclass
class ClientState:
    """A connected browser and its current image."""

    client: viser.ClientHandle
    version: int = 0
    """Incremented with every change of camera or options."""
    side: int = 0
    """Longer side of its image of this version, pixels; 0 for none."""
    last_render_time: float = 0.0
    """Monotonic time of its last image, seconds."""


class FieldPage(Page):
    """Serves a field: `run` repeatedly calls `render_next`, which renders one image.

    Args:
        name: title.
        system: the system to render.
        orbit: its middle is the home view.
        scene: photos with cameras to show, if any.
        host, port: see `Page`.
        max_side: longer side of the finest image, pixels.
        live: whether to show training progress.
    """

    def __init__(
        self,
        name: str,
        system: NeRF3D,
        orbit: Cameras,
        scene: Scene | None,
        host: str,
        port: int,
        max_side: int,
        live: bool = False,
    ):
        home, distance = get_home_viewpoint(orbit)
        super().__init__(name, home, distance, host, port)
        self.system = system
        self.painter = ProgressiveRenderer(system, orbit)
        red, green, blue = system.renderer.background.color.tolist()
        self.backgrounds = {"scene": (red, green, blue), **COLORS}
        self.scene = scene
        self.clients: dict[int, ClientState] = {}
        self.view_changed = threading.Condition()
        self.clicked: Rays | None = None
        with self.server.atomic():
            self.set_up_scene()
            if scene is not None:
                self.add_cameras(scene, visible=False)
            self._add_controls(max_side, live)
        self.server.on_client_connect(self._add_client)
        self.server.on_client_disconnect(self._remove_client)
        self.server.scene.on_click()(lambda event: self.click(event.ray_origin, event.ray_direction))

    def _add_client(self, client: viser.ClientHandle) -> None:
        client_state = ClientState(client)
        with self.view_changed:
            self.clients[client.client_id] = client_state
        client.camera.on_update(lambda _: self._request_images(client_state))
        self._request_images(client_state)

    def _remove_client(self, client: viser.ClientHandle) -> None:
        with self.view_changed:
            self.clients.pop(client.client_id, None)

    def _request_images(self, *clients: ClientState) -> None:
        """Invalidates the images of the given clients; of all if none is given."""
        with self.view_changed:
            for client_state in clients or tuple(self.clients.values()):
                client_state.version += 1
                client_state.side = 0
            self.view_changed.notify_all()

    def _add_controls(self, max_side: int, live: bool) -> None:
        gui = self.server.gui
        if live:
            self.bar, self.progress = gui.add_progress_bar(0.0), gui.add_markdown("")
        gui.add_markdown("Drag to turn, right-drag to move, scroll to zoom. Click the image to see a ray's samples.")
        gui.add_button("reset view").on_click(self.go_home)
        with gui.add_folder("image"):
            self.channel = gui.add_dropdown("channel", CHANNELS)
            self.background = gui.add_dropdown("background", tuple(self.backgrounds))
            side = min(max(max_side, 64), 2048)
            self.max_side = gui.add_slider("resolution", 64, 2048, 32, side, hint="longer side, pixels")
            max_far = float(f"{3 * self.scale:.2g}")
            step = max_far / 200
            self.near = gui.add_slider("near", 0.0, max_far, step, 0.0, hint="hide what is nearer")
            self.far = gui.add_slider("far", 0.0, max_far, step, max_far, hint="hide what is farther")
            for control in (self.channel, self.background, self.max_side, self.near, self.far):
                control.on_update(lambda _: self._request_images())
        with gui.add_folder("show"):
            self.draw_lines("/box", compute_box_edges(self.system.field.bounds.aabb.cpu()), parse_hex_color(GRAY))
            box = self.server.scene.get_handle_by_name("/box")
            assert box is not None  # it has edges
            box.visible = False
            self.add_checkbox("box", box)
            if self.scene is not None:
                self.add_camera_checkboxes()
            self.ray_group = self.server.scene.add_frame("/ray", show_axes=False)
            self.add_checkbox("clicked ray", self.ray_group)
        self.status = gui.add_markdown("")

    def click(self, origin: tuple[float, float, float], direction: tuple[float, float, float]) -> None:
        """Handles a click into the image: the next `render_next` draws its ray."""
        ahead = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float32), dim=0)
        self.clicked = Rays(torch.tensor(origin, dtype=torch.float32)[None], ahead[None])
        with self.view_changed:
            self.view_changed.notify_all()

    def show_progress(self, fraction: float, words: str) -> None:
        """Shows the progress of a live training.

        Args:
            fraction: in [0, 1].
            words: step, quality and time left.
        """
        self.bar.value, self.progress.content = 100 * fraction, words  # type: ignore[misc]  # settable

    def draw_ray(self, ray: Rays) -> None:
        """Draws a ray and its samples within the bounds, and shows its rendered values."""
        device = self.system.device
        ray = ray.to(device)
        with torch.no_grad():
            samples = self.system.sampler(ray, self.system.field.density)
            positions = samples.positions(ray)
            rendered = self.system.render(ray)
        near, far = (end.cpu() for end in self.system.field.bounds.near_far(ray))
        far = torch.minimum(torch.maximum(far, near), near + 4 * self.scale)
        ends = torch.stack([ray.origins.cpu() + t[:, None] * ray.directions.cpu() for t in (near, far)], dim=1)
        with self.draw_lock, self.server.atomic():
            self.draw_lines("/ray/inside", ends.numpy(), parse_hex_color(GREEN))
            self.points("/ray/samples", positions.cpu().numpy(), parse_hex_color(VERMILLION), 0.006)
        color = ", ".join(f"{float(c):.2f}" for c in rendered.rgb[0])
        depth, opacity = float(rendered.depth[0]), float(rendered.opacity[0])
        values = f"color {color}, opacity {opacity:.2f}, depth {depth:.3f}"
        self.status.content = f"clicked: {len(samples)} samples, {values}"

    def build_request(self, client_state: ClientState) -> ViewRequest:
        """The image that a client currently requests."""
        camera = client_state.client.camera
        c2w = np.eye(4)
        c2w[:3, :3] = SO3(camera.wxyz).as_matrix()
        c2w[:3, 3] = camera.position
        far = self.far.value if self.far.value < self.far.max else math.inf
        channel, background = self.channel.value, self.backgrounds[self.background.value]
        lens = camera.fov, camera.aspect
        return ViewRequest(c2w, *lens, channel, background, self.near.value, far, self.max_side.value)

    def next_client(self) -> ClientState | None:
        """The client with the coarsest image; None if all images have full resolution."""
        with self.view_changed:
            pending = [state for state in self.clients.values() if state.version and state.side < self.max_side.value]
            return min(pending, key=lambda state: (state.side, state.last_render_time), default=None)

    def render_next(self, seconds: float = FIRST_IMAGE_SECONDS) -> bool:
        """Renders a finer image for the client whose image is coarsest.

        Args:
            seconds: render time of the first image of a view.

        Returns:
            Whether there was anything to render.
        """
        if self.clicked is not None:
            ray, self.clicked = self.clicked, None
            self.draw_ray(ray)
        client_state = self.next_client()
        if client_state is None:
            return False
        version, previous = client_state.version, client_state.side
        request = self.build_request(client_state)
        first = self.painter.estimate_side(request, seconds)
        side = first if not previous else min(max(REFINEMENT_FACTOR * previous, first), request.max_side)
        image = self.painter.render(request, side, lambda: client_state.version == version)
        if image is None:
            return True
        client_state.client.scene.set_background_image(image, format="jpeg", jpeg_quality=JPEG_QUALITY)
        with self.view_changed:
            if client_state.version == version:
                client_state.side = max(side, 1)
            client_state.last_render_time = time.monotonic()
        return True

    def invalidate(self) -> None:
        """Requests new images for all clients, after the field has changed."""
        self.painter.reset_depth_range()
        self._request_images()

    def run(self, ended: Callable[[], bool] = lambda: False) -> None:
        """Renders requested images until `ended`."""
        while not ended():
            if not self.render_next():
                with self.view_changed:
                    self.view_changed.wait(timeout=0.5)
