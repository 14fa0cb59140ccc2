"""A trained field as a page in the browser: turned with the mouse, with the cameras that saw it."""

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
from nerf_lightning.drawing.frame import CHANNELS
from nerf_lightning.drawing.ink import GREEN, GREY, VERMILLION, rgb
from nerf_lightning.renderer.background import COLORS
from nerf_lightning.system import NeRF3D
from nerf_lightning.view.drawing import box_edges, home_of
from nerf_lightning.view.page import Page
from nerf_lightning.view.painter import Painter, Wish

FIRST_SECONDS = 0.08
"""Time to render the first picture after a movement: with encoding and transport it arrives within 0.2 s."""
FINER = 2
"""Times as many pixels along each side in each further picture, while the camera rests."""
QUALITY = 80
"""Of the JPEG that is sent, out of 100."""


@dataclass
class Visitor:
    """A browser that has the page open, and what it has been sent."""

    client: viser.ClientHandle
    version: int = 0
    """Goes up whenever what it wants changes."""
    side: int = 0
    """Pixels along the longer side of the picture it has of this version; 0 for none."""
    painted: float = 0.0
    """When it got its last picture, seconds of the monotonic clock."""


class FieldPage(Page):
    """Serves a field. `paint` renders one picture; `run` calls it for ever.

    Args:
        name: the page's title.
        system: what is shown.
        orbit: its first view is the page's.
        scene: the photos, whose cameras can then be shown; None for none.
        host, port: see `Page`.
        most: pixels along the longer side of the finest picture.
        live: whether `show_progress` will be called.
    """

    def __init__(
        self,
        name: str,
        system: NeRF3D,
        orbit: Cameras,
        scene: Scene | None,
        host: str,
        port: int,
        most: int,
        live: bool = False,
    ):
        home, distance = home_of(orbit)
        super().__init__(name, home, distance, host, port)
        self.system = system
        self.painter = Painter(system, orbit)
        red, green, blue = system.renderer.background.color.tolist()
        self.backgrounds = {"scene": (red, green, blue), **COLORS}
        self.scene = scene
        self.visitors: dict[int, Visitor] = {}
        self.changed = threading.Condition()
        self.clicked: Rays | None = None
        with self.server.atomic():
            self.set_stage()
            if scene is not None:
                self.add_cameras(scene, visible=False)
            self._add_controls(most, live)
        self.server.on_client_connect(self._welcome)
        self.server.on_client_disconnect(self._farewell)
        self.server.scene.on_click()(lambda event: self.click(event.ray_origin, event.ray_direction))

    def _welcome(self, client: viser.ClientHandle) -> None:
        visitor = Visitor(client)
        with self.changed:
            self.visitors[client.client_id] = visitor
        client.camera.on_update(lambda _: self._want(visitor))
        self._want(visitor)

    def _farewell(self, client: viser.ClientHandle) -> None:
        with self.changed:
            self.visitors.pop(client.client_id, None)

    def _want(self, *visitors: Visitor) -> None:
        """Marks what some visitors see as out of date; all visitors if none is named."""
        with self.changed:
            for visitor in visitors or tuple(self.visitors.values()):
                visitor.version += 1
                visitor.side = 0
            self.changed.notify_all()

    def _add_controls(self, most: int, live: bool) -> None:
        gui = self.server.gui
        if live:
            self.bar, self.progress = gui.add_progress_bar(0.0), gui.add_markdown("")
        gui.add_markdown(
            "Drag to turn, right-drag to move, scroll to zoom. Click into the picture to see a ray's samples."
        )
        gui.add_button("reset view").on_click(self.go_home)
        with gui.add_folder("picture"):
            self.channel = gui.add_dropdown("channel", CHANNELS)
            self.background = gui.add_dropdown("background", tuple(self.backgrounds))
            self.most = gui.add_slider("resolution", 64, 2048, 32, min(max(most, 64), 2048), hint="longer side, pixels")
            most_far = float(f"{3 * self.scale:.2g}")
            step = most_far / 200
            self.near = gui.add_slider("near", 0.0, most_far, step, 0.0, hint="hide what is nearer")
            self.far = gui.add_slider("far", 0.0, most_far, step, most_far, hint="hide what is farther")
            for control in (self.channel, self.background, self.most, self.near, self.far):
                control.on_update(lambda _: self._want())
        with gui.add_folder("show"):
            self.lines("/box", box_edges(self.system.field.bounds.aabb.cpu()), rgb(GREY))
            box = self.server.scene.get_handle_by_name("/box")
            assert box is not None  # it has edges
            box.visible = False
            self.switch("box", box)
            if self.scene is not None:
                self.add_camera_switches()
            self.ray_group = self.server.scene.add_frame("/ray", show_axes=False)
            self.switch("clicked ray", self.ray_group)
        self.status = gui.add_markdown("")

    def click(self, origin: tuple[float, float, float], direction: tuple[float, float, float]) -> None:
        """Called on a click into the picture: the next `paint` draws that ray."""
        ahead = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float32), dim=0)
        self.clicked = Rays(torch.tensor(origin, dtype=torch.float32)[None], ahead[None])
        with self.changed:
            self.changed.notify_all()

    def show_progress(self, share: float, words: str) -> None:
        """Shows how far a live training is.

        Args:
            share: done, in [0, 1].
            words: step, quality and time left.
        """
        self.bar.value, self.progress.content = 100 * share, words  # type: ignore[misc]  # settable

    def draw_ray(self, ray: Rays) -> None:
        """Draws one ray within the bounds and its samples, and prints what was rendered along it."""
        device = self.system.device
        ray = ray.to(device)
        with torch.no_grad():
            samples = self.system.sampler(ray, self.system.field.density)
            places = samples.positions(ray)
            rendered = self.system.render(ray)
        near, far = (end.cpu() for end in self.system.field.bounds.near_far(ray))
        far = torch.minimum(torch.maximum(far, near), near + 4 * self.scale)
        ends = torch.stack([ray.origins.cpu() + t[:, None] * ray.directions.cpu() for t in (near, far)], dim=1)
        with self.redrawing, self.server.atomic():
            self.lines("/ray/inside", ends.numpy(), rgb(GREEN))
            self.points("/ray/samples", places.cpu().numpy(), rgb(VERMILLION), 0.006)
        colour = ", ".join(f"{float(c):.2f}" for c in rendered.rgb[0])
        depth, opacity = float(rendered.depth[0]), float(rendered.opacity[0])
        self.status.content = (
            f"clicked: {len(samples)} samples, colour {colour}, opacity {opacity:.2f}, depth {depth:.3f}"
        )

    def wish(self, visitor: Visitor) -> Wish:
        """The picture that a visitor asks for now."""
        camera = visitor.client.camera
        c2w = np.eye(4)
        c2w[:3, :3] = SO3(camera.wxyz).as_matrix()
        c2w[:3, 3] = camera.position
        far = self.far.value if self.far.value < self.far.max else math.inf
        background = self.backgrounds[self.background.value]
        return Wish(
            c2w, camera.fov, camera.aspect, self.channel.value, background, self.near.value, far, self.most.value
        )

    def waiting(self) -> Visitor | None:
        """The visitor with the coarsest picture; None if all have the finest they want."""
        with self.changed:
            behind = [one for one in self.visitors.values() if one.version and one.side < self.most.value]
            return min(behind, key=lambda one: (one.side, one.painted), default=None)

    def paint(self, seconds: float = FIRST_SECONDS) -> bool:
        """Renders what is wanted most, once.

        Args:
            seconds: that the first picture of a view may take; finer ones take longer.

        Returns:
            Whether there was anything to do.
        """
        if self.clicked is not None:
            ray, self.clicked = self.clicked, None
            self.draw_ray(ray)
        visitor = self.waiting()
        if visitor is None:
            return False
        version, had = visitor.version, visitor.side
        wish = self.wish(visitor)
        first = self.painter.side_within(wish, seconds)
        side = first if not had else min(max(FINER * had, first), wish.most)
        picture = self.painter.paint(wish, side, lambda: visitor.version == version)
        if picture is None:
            return True
        visitor.client.scene.set_background_image(picture, format="jpeg", jpeg_quality=QUALITY)
        with self.changed:
            if visitor.version == version:
                visitor.side = max(side, 1)
            visitor.painted = time.monotonic()
        return True

    def again(self) -> None:
        """Called when the field has changed: all visitors get a new picture."""
        self.painter.forget()
        self._want()

    def run(self, ended: Callable[[], bool] = lambda: False) -> None:
        """Paints whenever a picture is wanted, until `ended`."""
        while not ended():
            if not self.paint():
                with self.changed:
                    self.changed.wait(timeout=0.5)
