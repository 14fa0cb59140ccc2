"""Web pages of one file each: templates filled by Jinja2, a content policy that allows a page's own style and script alone."""

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
"""Of page.html, which templates extend, and of page.css, which gives all pages one look."""


def render_page(template: Path, styles: Sequence[Path] = (), scripts: Sequence[Path] = (), **values: object) -> str:
    """Fills a template that extends page.html. Values are escaped, except those that are Markup.

    Args:
        template: an HTML file.
        styles, scripts: put into the page, after page.css.
        values: of the template, with `title`.
    """
    loader = FileSystemLoader([template.parent, TEMPLATE_FOLDER])
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    texts = {"style": (TEMPLATE_FOLDER / "page.css", *styles), "script": scripts}
    for name, files in texts.items():
        text = "\n".join(map(read_minified, files))
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        values |= {name: Markup(text), f"{name}_hash": f"sha256-{digest}"}  # for the content security policy
    return environment.get_template(template.name).render(values)


def read_minified(file: Path) -> str:
    """A script, shader or style without the comments and indents that only its readers need."""
    lines = (re.sub(r"(^|\s\s+)//.*$", "", line).strip() for line in file.read_text(encoding="utf-8").splitlines())
    return "\n".join(filter(None, lines))


def json_for_script(content: object) -> Markup:
    """Strict JSON in which nothing can end the script element that holds it."""
    return Markup(json.dumps(content, allow_nan=False).replace("<", "\\u003c"))


def relative_url(folder: Path, file: Path) -> str:
    """The relative address of a file for a page in a folder."""
    return quote(Path(os.path.relpath(file, folder)).as_posix())
