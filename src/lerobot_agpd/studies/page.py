"""One HTML file about some runs: table, pictures, rounds, and the commands to go on with; it needs no other file."""

from __future__ import annotations

import base64
import mimetypes
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from lerobot_agpd.files import write_text
from lerobot_agpd.studies.tables import Row

STYLE = """
:root { color-scheme: light dark; --line: #8885; --soft: #8882; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 64rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.7rem; } h2 { margin-top: 2.5rem; border-bottom: 1px solid var(--line); }
table { border-collapse: collapse; margin: 1rem 0; font-size: 0.92rem; display: block; overflow-x: auto; }
th, td { padding: 0.3rem 0.8rem; border-bottom: 1px solid var(--line); text-align: left; white-space: nowrap; }
th { font-weight: 600; } figure { margin: 1.5rem 0; } figcaption { font-size: 0.9rem; opacity: 0.8; }
img { max-width: 100%; height: auto; background: #fff; border-radius: 4px; }
pre { background: var(--soft); padding: 0.8rem; overflow-x: auto; border-radius: 4px; font-size: 0.85rem; }
"""

DOCUMENT = """\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<h1>{title}</h1>
{body}
</body>
</html>
"""

READING = (
    "Intervals are 95 % over episodes (Wilson for success, Student's t for rewards). The environments were used by "
    "neither training nor collection."
)


@dataclass(frozen=True)
class RunPart:
    """What the page says of one run.

    Attributes:
        name: of the run.
        rounds: table of its collection rounds; empty without any.
        ways: table of the ways that kept episodes took; empty in a task with one way.
        pictures: caption to file.
        commands: what to do with it: label to arguments.
    """

    name: str
    rounds: Sequence[Row]
    ways: Sequence[Row]
    pictures: Mapping[str, Path]
    commands: Mapping[str, Sequence[str]]


def write_page(
    path: Path,
    title: str,
    environment: str,
    summary: Sequence[Row],
    pictures: Mapping[str, Path],
    runs: Sequence[RunPart],
) -> None:
    """Write the page.

    Args:
        path: of the HTML file.
        title: of the page.
        environment: where policies were evaluated.
        summary: table of all policies.
        pictures: caption to file, PNG, GIF or MP4.
        runs: what to say of every run.
    """
    parts = [f"<p>{escape(environment)}</p>", _table(summary), f"<p>{escape(READING)}</p>"]
    parts += [_figure(file, caption) for caption, file in pictures.items()]
    for run in runs:
        parts.append(f"<h2>{escape(run.name)}</h2>")
        if run.rounds:
            parts += ["<h3>Collection rounds</h3>", _table(run.rounds)]
        if run.ways:
            parts += ["<h3>Kept episodes on every way (entropy in nats)</h3>", _table(run.ways)]
        parts += [_figure(file, caption) for caption, file in run.pictures.items()]
        parts += [
            f"<p>{escape(label)}</p><pre>{escape(shlex.join(map(str, command)))}</pre>"
            for label, command in run.commands.items()
        ]
    write_text(path, DOCUMENT.format(title=escape(title or "Report"), style=STYLE, body="\n".join(parts)))


def _table(rows: Sequence[Row]) -> str:
    header, *body = rows
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    lines = "\n".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in body)
    return f"<table><thead><tr>{head}</tr></thead><tbody>\n{lines}\n</tbody></table>"


def _figure(file: Path, caption: str) -> str:
    """A picture or a film inside the page."""
    kind = mimetypes.guess_type(file.name)[0] or "image/png"
    source = f"data:{kind};base64,{base64.b64encode(file.read_bytes()).decode()}"
    if kind.startswith("video/"):
        shown = f'<video controls loop muted src="{source}"></video>'
    else:
        shown = f'<img alt="{escape(caption)}" src="{source}">'
    return f"<figure>{shown}<figcaption>{escape(caption)}</figcaption></figure>"
