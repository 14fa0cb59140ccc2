"""What two runs must share before their figures can stand on one axis."""

from dataclasses import dataclass
from typing import Any

from nerf_lightning.runs.index import Run

NAMED: dict[tuple[float, ...], str] = {(0.0, 0.0, 0.0): "black background", (1.0, 1.0, 1.0): "white background"}


@dataclass(frozen=True)
class Setting:
    """Scene, resolution, split, background and machine of a run, in words if they are only shown."""

    scene: str
    fingerprint: str
    """First letters of the SHA-256 of the pictures and their split; "" where it is not known."""
    resolution: str
    views: str
    background: str
    machine: str

    def words(self) -> str:
        scene = " ".join(filter(None, [self.scene, self.resolution, self.fingerprint and f"({self.fingerprint})"]))
        return ", ".join(filter(None, [scene, self.views, self.background])) + f"; {self.machine}"


def setting_of(run: Run) -> Setting:
    """A run's setting, from its results.json; what does not stand there is called unknown."""
    scene = run.results.get("scene")
    known: dict[str, Any] = scene if isinstance(scene, dict) else {}
    return Setting(
        scene=str(known.get("name") or "unknown scene"),
        fingerprint=str(known.get("sha256") or "")[:8],
        resolution=_resolution(known.get("resolution")),
        views=_views(known.get("views")),
        background=_background(run.results),
        machine=_machine(run.results),
    )


def _resolution(found: Any) -> str:
    if isinstance(found, list) and len(found) == 2:
        return f"{found[0]}x{found[1]}"
    return "unknown resolution"


def _views(found: Any) -> str:
    if not isinstance(found, dict):
        return "unknown split"
    return f"{found.get('train', '?')} training and {found.get('val', '?')} held-out views"


def _background(results: dict[str, Any]) -> str:
    found = results.get("background", "unknown")
    if found is None:
        return ""  # a picture has nothing behind it
    if not isinstance(found, list) or not all(isinstance(part, int | float) for part in found):
        return "unknown background"
    return NAMED.get(tuple(float(part) for part in found)) or f"background {found}"


def _machine(results: dict[str, Any]) -> str:
    found, device, threads = (results.get(key) for key in ("machine", "device", "threads"))
    if not isinstance(found, dict):
        return f"unknown machine ({device}, {threads} threads)"
    kind = str(device or "cpu").partition(":")[0]
    words = f"{found.get('processor', 'unknown processor')}, {threads} threads on {found.get('cores', '?')} cores"
    accelerator = found.get("accelerator")
    return words if kind == "cpu" and not accelerator else f"{accelerator or words} ({kind})"
