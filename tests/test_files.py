"""Files are read and written whole or not at all; errors are one printable line, whatever they quote."""

import os
import pickle

import pytest

from cvqmpt_lab.errors import LONGEST_LINE, InvalidInputError, RunStoreError, UnknownChoiceError
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


@pytest.mark.parametrize(
    ("use", "words"),
    [
        (lambda p: read_text(p / "absent", "task"), "cannot read task .*/absent: No such file"),
        (lambda p: read_text(p / "latin"), r"file .*/latin is not UTF-8 text \(byte 0\)"),
        (lambda p: write_text(p / "latin" / "below", ""), "cannot write .*/below: Not a directory"),
        (lambda p: make_folder(p / "latin"), "cannot make folder .*/latin: File exists"),
        (lambda p: read_json_object("/dev/zero", "scene"), "cannot read scene /dev/zero: it is a device"),
        (lambda p: json_value('{"a": 1, "a": {}}', "x"), "key 'a' occurs twice"),
        (lambda p: json_value(r'{"a": ["\uD800"]}', "x"), r"x is not json: .*surrogates"),
        (lambda p: json_value("<html>", "x"), "is not json"),
        (lambda p: json_value("[" * 100_000, "x"), "is not json"),
    ],
)
def test_what_cannot_be_read_or_written_is_named(tmp_path, use, words):
    (tmp_path / "latin").write_bytes(b"\xe9")
    with pytest.raises(InvalidInputError, match=words):
        use(tmp_path)


@pytest.mark.parametrize("name", ["a\0b", "a\ud800", "x" * 5000])
def test_a_name_that_no_file_can_have_is_refused(tmp_path, name):
    with pytest.raises(InvalidInputError, match="cannot read scan") as caught:
        read_bytes(require_regular_file(tmp_path / name, "scan"), "scan")
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    "error",
    [
        InvalidInputError(f"cannot read scene {'x' * 9000}: File name too long; choose another"),
        RunStoreError("a\nb\x1b[31m\ud800; choose another"),
        UnknownChoiceError("thing", "é\n" * 5000, ["a" * 3000, "another"]),
    ],
)
def test_an_error_is_one_printable_line_that_keeps_its_end(error):
    assert str(error).isprintable() and len(str(error)) <= LONGEST_LINE and "another" in str(error)[-60:]
    str(error).encode()


@pytest.mark.parametrize(
    "error",
    [
        InvalidInputError("cannot write a  b; choose a folder"),
        UnknownChoiceError("planner", "birt", ["birrt", "mpnet"]),
    ],
)
def test_an_error_of_a_worker_arrives(error):
    arrived = pickle.loads(pickle.dumps(error))
    assert type(arrived) is type(error) and str(arrived) == str(error)
