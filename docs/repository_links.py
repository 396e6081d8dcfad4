"""Hooks of mkdocs: pages link to files of the repository outside docs/, as they do when read in it.

Pictures are copied into the site. Links to source code and folders go to `repo_url` if mkdocs.yml has one; without,
they become the file's name.
"""

import posixpath
import re
from pathlib import Path

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
LINK = re.compile(r"(?P<bang>!?)\[(?P<text>[^\]]*)\]\((?P<target>[^)\s#]+)(?P<anchor>#[^)]*)?\)")
PICTURES = {".png", ".gif", ".svg"}


def outside(target: str, source: str) -> str | None:
    """A link's target relative to the repository, if it is a file or folder outside docs/; else None."""
    if "://" in target or target.startswith("mailto:"):
        return None
    path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(source), target))
    return None if path.startswith(("docs/", "..")) or not (ROOT / path).exists() else path


def on_files(files: Files, config) -> Files:
    """Add the pictures outside docs/ that pages show."""
    for page in list(files.documentation_pages()):
        for match in LINK.finditer(page.content_string):
            path = outside(match["target"], page.src_uri)
            if path and Path(path).suffix in PICTURES and files.get_file_from_path(path) is None:
                files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page, config, files) -> str:
    """Point links outside docs/ to where their targets are on the site, or name them."""

    def replaced(match: re.Match) -> str:
        path = outside(match["target"], page.file.src_uri)
        if path is None:
            return match[0]
        if Path(path).suffix in PICTURES:
            here = posixpath.dirname(page.file.src_uri)
            return f"{match['bang']}[{match['text']}]({posixpath.relpath(path, here or '.')})"
        if config.repo_url:
            return f"[{match['text']}]({config.repo_url.rstrip('/')}/blob/main/{path})"
        name = match["text"].strip("`")
        return f"`{path}`" if name == path or name in path else f"{match['text']} (`{path}`)"

    return LINK.sub(replaced, markdown)
