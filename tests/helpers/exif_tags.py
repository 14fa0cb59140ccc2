"""What cameras write into photos."""

from PIL import Image
from PIL.TiffImagePlugin import IFDRational


def encode_exif(
    orientation: int = 1, make: str = "", model: str = "", focal: float | IFDRational = 0.0, focal_35mm: int = 0,
    seconds: float | IFDRational = 0.0, aperture: float = 0.0, speed: int = 0,
) -> bytes:  # fmt: skip
    """EXIF, without the tags that are empty or 0; focal lengths in millimeters."""
    exif = Image.Exif()
    details = exif.get_ifd(0x8769)
    for target, tag, value in (
        (exif, 0x0112, orientation),
        (exif, 0x010F, make),
        (exif, 0x0110, model),
        (details, 0x920A, focal),
        (details, 0xA405, focal_35mm),
        (details, 0x829A, seconds),
        (details, 0x829D, aperture),
        (details, 0x8827, speed),
    ):
        if value:
            target[tag] = value
    return exif.tobytes()
