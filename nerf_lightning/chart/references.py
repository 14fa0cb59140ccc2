"""Published figures, to stand beside one's own: never measured here, and always drawn as such."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nerf_lightning.chart.setting import Setting
from nerf_lightning.errors import InputError
from nerf_lightning.utils.options import check_options


@dataclass(frozen=True)
class Reference:
    """One published figure."""

    name: str
    psnr: float
    """dB, held out."""
    seconds: float
    """Of training."""
    source: str
    hardware: str
    scene: str
    """Name of the scene it was measured on."""
    conditions: str
    """Resolution, views and background, in words."""


def publication(source: str, hardware: str, scene: str, conditions: str, methods: dict[str, list[float]]) -> None:
    """The keys of one entry of conf/references/*.yaml, for checking."""


def read_references(publications: Mapping[str, Any]) -> list[Reference]:
    """Checks and reads what stands in the group `references`.

    Raises:
        InputError: where an entry lacks something, or has a value that cannot be.
    """
    found = []
    for name, entry in publications.items():
        where = f"references.{name}"
        if not isinstance(entry, dict):
            raise InputError("config", where, repr(entry), "source, hardware, scene, conditions and methods")
        check_options(where, publication, entry)
        origin = {key: value for key, value in entry.items() if key != "methods"}
        for method, pair in entry["methods"].items():
            if len(pair) != 2 or not all(0 < value < math.inf for value in pair):
                expected = "dB and seconds, both more than 0, as [35.7, 161]"
                raise InputError("config", f"{where}.methods.{method}", repr(pair), expected)
            found.append(Reference(str(method), float(pair[0]), float(pair[1]), **origin))
    return found


def matching(references: Iterable[Reference], setting: Setting) -> list[Reference]:
    """Those of the setting's scene, by rising time."""
    chosen = [one for one in references if one.scene.lower() == setting.scene.lower()]
    return sorted(chosen, key=lambda one: one.seconds)


def provenance(references: Sequence[Reference]) -> list[str]:
    """Where references come from, a line for each origin."""
    origins: dict[tuple[str, str, str], list[str]] = {}
    for one in references:
        origins.setdefault((one.conditions, one.hardware, one.source), []).append(one.name)
    return [
        f"Published, other hardware: {', '.join(names)}: {conditions}; {hardware}; {source}."
        for (conditions, hardware, source), names in origins.items()
    ]
