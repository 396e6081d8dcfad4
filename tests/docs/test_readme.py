"""Pages say what is there: their example from Python is the example's code, and their links lead somewhere."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [
    path
    for pattern in ("*.md", "docs/**/*.md")
    for path in sorted(ROOT.glob(pattern))
    if path.name != "model_card.md"  # a card of the Hub
]
LINK = re.compile(r"\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)


def anchor(heading: str) -> str:
    """As GitHub and the site name it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")


def test_the_page_shows_the_example() -> None:
    source = (ROOT / "examples/train_fetchreach.py").read_text()
    (main,) = [node for node in ast.parse(source).body if isinstance(node, ast.FunctionDef)]
    page = (ROOT / "docs/recipes/python.md").read_text()
    assert f"```python\n{ast.get_source_segment(source, main)}\n```" in page


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    missing = []
    for target in LINK.findall(page.read_text()):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, fragment = target.partition("#")
        file = (page.parent / path) if path else page
        if not file.exists():
            missing.append(target)
        elif fragment and file.suffix == ".md":
            headings = [anchor(heading) for heading in HEADING.findall(file.read_text())]
            missing += [target] * (fragment not in headings)
    assert not missing


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if "--8" in page.read_text()],
    ids=lambda path: str(path.relative_to(ROOT)),
)
def test_included_files_are_there(page: Path) -> None:
    """A formatter of Python may rewrite the mark, which the site would then show."""
    for mark in re.findall(r"^--8.*$", page.read_text(), re.MULTILINE):
        (file,) = re.findall(r'^--8<-- "(.+)"$', mark)
        assert (ROOT / file).is_file()


def test_the_first_page_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120
