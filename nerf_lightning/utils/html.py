"""Single-file web pages: Jinja2 templates with a content security policy that allows only their own style and script."""

import base64
import hashlib
import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

TEMPLATE_FOLDER = Path(__file__).parent
"""Holds page.html, the base template, and page.css, the shared style."""


def render_page(template: Path, styles: Sequence[Path] = (), scripts: Sequence[Path] = (), **values: object) -> str:
    """Renders a template that extends page.html; escapes all values except Markup.

    Args:
        template: an HTML file.
        styles, scripts: inlined after page.css.
        values: of the template, with `title`.
    """
    loader = FileSystemLoader([template.parent, TEMPLATE_FOLDER])
    jinja = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    texts = {"style": (TEMPLATE_FOLDER / "page.css", *styles), "script": scripts}
    for name, files in texts.items():
        text = "\n".join(map(read_minified, files))
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        values |= {name: Markup(text), f"{name}_hash": f"sha256-{digest}"}  # for the content security policy
    return jinja.get_template(template.name).render(values)


def read_minified(file: Path) -> str:
    """The text of a script, shader or style without comments and indentation."""
    lines = (re.sub(r"(^|\s\s+)//.*$", "", line).strip() for line in file.read_text(encoding="utf-8").splitlines())
    return "\n".join(filter(None, lines))


def json_for_script(content: object) -> Markup:
    """Strict JSON that cannot close its script element."""
    return Markup(json.dumps(content, allow_nan=False).replace("<", "\\u003c"))


def relative_url(folder: Path, file: Path) -> str:
    """The URL of a file relative to a page's folder."""
    return quote(Path(os.path.relpath(file, folder)).as_posix())
