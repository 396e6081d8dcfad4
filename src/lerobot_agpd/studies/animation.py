"""Policies side by side from the same starts, as a GIF or an MP4."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from lerobot.utils.io_utils import write_video
from PIL import Image, ImageDraw, ImageFont

from lerobot_agpd.flag_checks import require
from lerobot_agpd.replay.episode import Array

SUFFIXES = (".gif", ".mp4")
FONT = "DejaVuSans.ttf"  # matplotlib's, which is always there
BACKGROUND, TEXT = (255, 255, 255), (40, 40, 40)
SUCCESS, FAILURE = (0, 158, 115), (213, 94, 0)
BORDER = 4  # pixels
LARGE_COLORS, SMALL_COLORS = 80, 48
"""Of a GIF's palette, for large surfaces and for small things: simulators are plain, and colors cost bytes."""

PAUSE = 0.8
"""Seconds that a finished episode stays."""

Color = tuple[int, int, int]


@dataclass(frozen=True)
class Line:
    """A chunk on a frame.

    Attributes:
        points: (n, 2) pixels of the rendered frame.
        color: of the line.
    """

    points: Array
    color: Color


@dataclass(frozen=True)
class Clip:
    """One episode of one policy.

    Attributes:
        frames: rendered frames (H, W, 3) uint8, one per step.
        success: None if the environment reports none.
        lines: step to what is drawn on its frame.
    """

    frames: Sequence[Array]
    success: bool | None
    lines: Mapping[int, Sequence[Line]] = field(default_factory=dict)


@dataclass(frozen=True)
class Style:
    """How an animation looks.

    Attributes:
        width: of a panel, pixels.
        stride: every how many-th step is shown.
        fps: shown frames per second.
    """

    width: int = 240
    stride: int = 1
    fps: float = 10.0


def require_animation(path: Path | None) -> None:
    """Refuse a file that is neither a GIF nor an MP4; `--animation` in the message."""
    require(
        path is None or path.suffix in SUFFIXES,
        f"--animation={path} must end with {' or '.join(SUFFIXES)}",
    )


def write_animation(rows: Mapping[str, Sequence[Clip]], path: Path, style: Style) -> None:
    """Play the episodes of every policy, beside each other and one after the other.

    An episode that ends sooner waits for the others with a border that tells its outcome; names count successes.

    Args:
        rows: policy's name to its episodes; every policy has the same starts in the same order.
        path: `.gif` or `.mp4`.
        style: how it looks.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    frames = list(_frames(rows, style))
    if path.suffix == ".mp4":
        write_video(path, [np.asarray(frame) for frame in frames], fps=round(style.fps))
        return
    palette = _palette(frames)
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    first.save(
        path, save_all=True, append_images=others, duration=round(1000 / style.fps), loop=0, optimize=True
    )


def _palette(frames: Sequence[Image.Image]) -> Image.Image:
    """One palette for all frames, from all over the film: a GIF then stores what changes alone.

    Median cut spends its colors on what is large; a few more cover what is small and bright, such as a cube or a border.
    """
    shown = [np.asarray(frame) for frame in frames[:: len(frames) // 8 + 1]]
    borders = [np.full_like(shown[0][:8], color) for color in (SUCCESS, FAILURE)]
    sample = Image.fromarray(np.concatenate(shown + borders))
    colors: list[int] = []
    for n_colors, method in (
        (LARGE_COLORS, Image.Quantize.MEDIANCUT),
        (SMALL_COLORS, Image.Quantize.MAXCOVERAGE),
    ):
        colors += (sample.quantize(n_colors, method).getpalette() or [])[: 3 * n_colors]
    palette = Image.new("P", (1, 1))
    palette.putpalette(colors)
    return palette


def _frames(rows: Mapping[str, Sequence[Clip]], style: Style) -> Iterator[Image.Image]:
    n_episodes = len(next(iter(rows.values())))
    for episode in range(n_episodes):
        clips = {name: clips[episode] for name, clips in rows.items()}
        before = {name: [clip.success for clip in clips[:episode]] for name, clips in rows.items()}
        longest = max(len(clip.frames) for clip in clips.values())
        pause = round(PAUSE * style.fps)
        for step in [*range(0, longest, style.stride), *[longest] * pause]:
            panels = [_panel(name, clip, step, before[name], style) for name, clip in clips.items()]
            yield Image.fromarray(np.concatenate([np.asarray(panel) for panel in panels], axis=1))


def _panel(name: str, clip: Clip, step: int, before: Sequence[bool | None], style: Style) -> Image.Image:
    """A policy's frame at a step under its name."""
    shown = min(step, len(clip.frames) - 1)
    is_over = step >= len(clip.frames) - 1
    frame = Image.fromarray(clip.frames[shown])
    scale = style.width / frame.width
    frame = frame.resize((style.width, round(frame.height * scale)), Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(frame)
    for line in clip.lines.get(shown, ()):
        points = [tuple(point) for point in (line.points * scale).tolist()]
        for ends in pairwise(points):
            draw.line(ends, fill=line.color, width=3)
    if is_over and clip.success is not None:
        draw.rectangle(
            (0, 0, frame.width - 1, frame.height - 1),
            outline=SUCCESS if clip.success else FAILURE,
            width=BORDER,
        )
    outcomes = [*before, clip.success] if is_over else list(before)
    header = max(18, style.width // 10)
    panel = Image.new("RGB", (frame.width, frame.height + header), BACKGROUND)
    panel.paste(frame, (0, header))
    text = ImageDraw.Draw(panel)
    font = label_font(round(0.62 * header))
    text.text((5, header / 2), name, fill=TEXT, font=font, anchor="lm")
    if outcomes and None not in outcomes:
        tally = f"{sum(map(bool, outcomes))} of {len(outcomes)}"
        text.text((frame.width - 5, header / 2), tally, fill=TEXT, font=font, anchor="rm")
    return panel


@cache
def label_font(size: int) -> ImageFont.FreeTypeFont:
    """The font of all labels, in pixels."""
    from matplotlib import get_data_path

    return ImageFont.truetype(Path(get_data_path()) / "fonts" / "ttf" / FONT, size)


def executed_lines(
    actions: Array, n_steps: int, to_frame: Callable[[Array], Array], color: Color
) -> dict[int, list[Line]]:
    """What is left of the executed chunk at every step.

    Args:
        actions: (T, A) of an episode.
        n_steps: executed per chunk.
        to_frame: maps actions to pixels.
        color: of the lines.
    """
    points = to_frame(actions)
    return {
        step: [Line(points[step : step - step % n_steps + n_steps], color)] for step in range(len(actions))
    }
