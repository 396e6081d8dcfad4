"""Animations, contact sheets' labels and pages of synthetic episodes."""

import re

import numpy as np
import pytest
from PIL import Image

from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.studies.animation import (
    FAILURE,
    PAUSE,
    SUCCESS,
    Clip,
    Line,
    Style,
    executed_lines,
    require_animation,
    write_animation,
)
from lerobot_agpd.studies.page import RunPart, write_page

STYLE = Style(width=40, stride=2, fps=10.0)


def clip(n_steps: int, success: bool, shade: int = 100, **drawn) -> Clip:
    return Clip([np.full((40, 40, 3), shade, np.uint8)] * n_steps, success, **drawn)


def near(pixel, color) -> bool:
    return bool(np.abs(np.asarray(pixel, int) - color).max() < 40)


def frames_of(path) -> list[np.ndarray]:
    with Image.open(path) as film:
        frames = []
        for number in range(film.n_frames):
            film.seek(number)
            frames.append(np.asarray(film.convert("RGB")))
        return frames


def test_policies_are_side_by_side_and_wait_for_the_slowest(tmp_path):
    rows = {"one": [clip(4, True), clip(10, False)], "two": [clip(8, False), clip(10, True)]}
    write_animation(rows, tmp_path / "film.gif", STYLE)
    frames = frames_of(tmp_path / "film.gif")
    assert frames[0].shape[1] == 2 * STYLE.width
    bottom = frames[0].shape[0] - 1
    assert not near(frames[0][bottom, 5], SUCCESS)
    # The left one is over at its fourth step; equal frames are one.
    assert near(frames[1][bottom, 5], SUCCESS) and not near(frames[1][bottom, 45], FAILURE)
    assert near(frames[2][bottom, 5], SUCCESS) and near(frames[2][bottom, 45], FAILURE)
    last = frames[-1]
    assert near(last[bottom, 5], FAILURE) and near(last[bottom, 45], SUCCESS)


def test_the_film_ends_when_the_slowest_does(tmp_path):
    """Equal frames may be merged, so the time counts."""
    write_animation({"one": [clip(4, True)], "two": [clip(8, False)]}, tmp_path / "film.gif", STYLE)
    with Image.open(tmp_path / "film.gif") as film:
        durations = []
        for number in range(film.n_frames):
            film.seek(number)
            durations.append(film.info["duration"])
    assert sum(durations) == pytest.approx(1000 * (4 / STYLE.fps + PAUSE))


def test_chunks_are_drawn_where_they_belong(tmp_path):
    line = Line(np.array([[5.0, 20.0], [35.0, 20.0]]), (255, 0, 0))
    write_animation({"one": [clip(1, True, lines={0: [line]})]}, tmp_path / "film.gif", STYLE)
    frame = frames_of(tmp_path / "film.gif")[0]
    header = frame.shape[0] - 40
    assert near(frame[header + 20, 20], (255, 0, 0)) and not near(frame[header + 30, 20], (255, 0, 0))


def test_what_is_left_of_the_executed_chunk():
    actions = np.arange(10, dtype=float).reshape(5, 2)
    lines = executed_lines(actions, 2, lambda points: 10 * points, (0, 0, 0))
    assert [len(lines[step][0].points) for step in range(5)] == [2, 1, 2, 1, 1]
    np.testing.assert_array_equal(lines[3][0].points, 10 * actions[3:4])


def test_an_mp4_plays_all_frames(tmp_path):
    av = pytest.importorskip("av")
    write_animation({"one": [clip(8, True)]}, tmp_path / "film.mp4", STYLE)
    with av.open(str(tmp_path / "film.mp4")) as film:
        assert len(list(film.decode(video=0))) == 4 + round(PAUSE * STYLE.fps)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(FlagError, match="--animation=.*film.avi"):
        require_animation(tmp_path / "film.avi")


def test_a_page_holds_its_pictures_and_escapes_names(tmp_path):
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    run = RunPart("<run>", [("round",), ("0",)], [], {"sheet": tmp_path / "a.png"}, {"Go": ["cmd", "a b"]})
    write_page(tmp_path / "page.html", "T", "env", [("", "success"), ("x", "1")], {}, [run])
    text = (tmp_path / "page.html").read_text()
    assert "&lt;run&gt;" in text and "cmd &#x27;a b&#x27;" in text
    assert not re.search(r'(src|href)="(?!data:)', text), "it needs no other file"
