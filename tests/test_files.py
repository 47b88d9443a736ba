import os

import pytest

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import (
    json_value,
    locked,
    make_folder,
    read_bytes,
    read_json_object,
    read_text,
    replacing,
    require_regular_file,
    write_bytes,
    write_text,
)


def names(folder):
    return [path.name for path in folder.iterdir()]


def test_written_text_comes_back_and_nothing_else_is_left(tmp_path):
    write_text(tmp_path / "a.txt", "μ\n")
    write_text(tmp_path / "a.txt", "σ\n")
    assert read_text(tmp_path / "a.txt") == "σ\n"
    assert names(tmp_path) == ["a.txt"]


def test_a_full_disk_keeps_the_old_file_and_leaves_no_other(tmp_path, monkeypatch):
    write_bytes(tmp_path / "a", b"old")

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InvalidInputError, match=r"cannot write .*/a: No space left"):
        write_bytes(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"old"
    assert names(tmp_path) == ["a"]


def test_what_fails_while_writing_is_not_moved_into_place(tmp_path):
    with pytest.raises(RuntimeError), replacing(tmp_path / "film.gif") as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert names(tmp_path) == []


def test_who_locks_a_folder_clears_what_killed_writers_left_in_it_and_nothing_else(tmp_path):
    (tmp_path / "shards").mkdir()
    with replacing(tmp_path / "shards" / "a.npz") as temporary:
        temporary.touch()
    temporary.write_text("half")
    (tmp_path / "shards" / "a.npz").unlink()
    for name in ("a.npz", ".mine.tmp", ".git"):
        (tmp_path / name).write_text("whole")
    with locked(tmp_path):
        assert sorted(names(tmp_path)) == [".git", ".mine.tmp", "a.npz", "shards"]
        assert names(tmp_path / "shards") == []


def test_errors_name_the_path(tmp_path):
    (tmp_path / "latin").write_bytes(b"\xe9")
    for run, words in (
        (lambda: read_text(tmp_path / "absent", "task"), "cannot read task .*/absent: No such file"),
        (lambda: read_text(tmp_path / "latin"), r"file .*/latin is not UTF-8 text \(byte 0\)"),
        (lambda: write_text(tmp_path / "latin" / "below", ""), "cannot write .*/below: Not a directory"),
        (lambda: make_folder(tmp_path / "latin"), "cannot make folder .*/latin: File exists"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            run()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"a": 1, "a": {}}', "key 'a' occurs twice"),
        ("[1]", "must hold one json object"),
        ("<html>", "is not json"),
        ("[" * 100_000, "is not json"),
    ],
)
def test_a_file_that_is_no_plain_json_object_is_refused(tmp_path, text, words):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InvalidInputError, match=words):
        read_json_object(tmp_path / "a.json", "problem")


@pytest.mark.parametrize("name", ["a\0b", "a\ud800", "x" * 5000])
def test_a_name_that_no_file_can_have_is_refused(tmp_path, name):
    with pytest.raises(InvalidInputError, match="cannot read scan") as caught:
        read_bytes(require_regular_file(tmp_path / name, "scan"), "scan")
    assert str(caught.value).isprintable()


def test_a_device_is_not_read_for_ever():
    with pytest.raises(InvalidInputError, match="cannot read scene /dev/zero: it is a device"):
        read_json_object("/dev/zero", "scene")


def test_json_with_half_a_character_is_refused_and_a_whole_one_read():
    """No file can hold the half: a table of such a provenance could not be written."""
    assert json_value(r'{"a": "\ud83e\udd16"}', "this") == {"a": "\U0001f916"}
    with pytest.raises(InvalidInputError, match=r"this is not json: .*surrogates"):
        json_value(r'{"a": ["\uD800"]}', "this")
