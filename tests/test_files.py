"""Files that are replaced in one go."""

import errno
import resource

import pytest

from lerobot_agpd.files import append_line, complete_lines, read_json, write_json, write_text


def test_a_failed_write_leaves_the_old_content(tmp_path):
    path = tmp_path / "x.json"
    write_json(path, {"a": 1})
    loop: dict = {}
    loop["loop"] = loop
    with pytest.raises(ValueError, match="Circular"):
        write_json(path, loop)
    assert read_json(path) == {"a": 1} and [entry.name for entry in tmp_path.iterdir()] == ["x.json"]


def test_a_process_killed_while_writing_leaves_the_old_content(tmp_path, monkeypatch):
    path = tmp_path / "x.txt"
    write_text(path, "old")

    def killed(descriptor: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("os.fsync", killed)
    with pytest.raises(KeyboardInterrupt):
        write_text(path, "new")
    assert path.read_text() == "old"


def test_paths_become_strings(tmp_path):
    write_json(tmp_path / "x.json", {"a": tmp_path})
    assert read_json(tmp_path / "x.json") == {"a": str(tmp_path)}


@pytest.mark.parametrize("text", ['{"a": ', "[1]"])
def test_damaged_files_are_named(tmp_path, text):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(ValueError, match=r"x\.json"):
        read_json(tmp_path / "x.json")


@pytest.fixture
def small_disk():
    """No file of this process can be larger than 100 bytes, which fails as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_is_named_with_the_file(tmp_path, small_disk):
    """Python's own message names no file; what was there before stays whole."""
    path, lines = tmp_path / "x.txt", tmp_path / "x.jsonl"
    write_text(path, "old")
    append_line(lines, "first")
    for write in (write_text, append_line):
        file = path if write is write_text else lines
        with pytest.raises(OSError, match=str(file)) as failed:
            write(file, "x" * 200)
        assert failed.value.errno == errno.EFBIG
    assert path.read_text() == "old" and complete_lines(lines) == ["first"]
