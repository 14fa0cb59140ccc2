"""What goes into web pages: data, and addresses of other pages."""

import json
import os
from pathlib import Path
from urllib.parse import quote


def script_data(content: object) -> str:
    """Strict JSON in which nothing can end the script element that holds it."""
    return json.dumps(content, allow_nan=False).replace("<", "\\u003c")


def address_from(folder: Path, file: Path) -> str:
    """The relative address of a file for a page in a folder."""
    return quote(Path(os.path.relpath(file, folder)).as_posix())
