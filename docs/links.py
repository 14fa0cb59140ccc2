"""An mkdocs hook: README.md is the first page, and links to files outside docs/ lead to the repository, if there is one."""

import re
from pathlib import Path


def on_page_markdown(markdown: str, page, config, **_) -> str:
    if page.file.src_uri == "index.md":
        readme = (Path(config.docs_dir).parent / "README.md").read_text(encoding="utf-8")
        markdown = re.sub(r"\]\((?=[A-Za-z])(?!docs/|https?:)", "](../", readme).replace("](docs/", "](")
    markdown = markdown.replace("](../README.md", "](index.md")
    source = rf"[\1]({config.repo_url}/blob/main/\2)" if config.repo_url else r"`\1`"
    return re.sub(r"\[([^\[\]]+)\]\(\.\./([^)]+)\)", source, markdown)
