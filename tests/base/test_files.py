"""Files are read and written completely or not at all; errors are one printable line."""

import os
import pickle
import tempfile
import threading
from pathlib import Path

import pytest
from refusals import refused

from cvqmpt_lab.base import caches
from cvqmpt_lab.base.caches import cache_folder, trusted_cache
from cvqmpt_lab.base.errors import (
    MAX_MESSAGE_CHARACTERS,
    InvalidInputError,
    RunStoreError,
    UnknownChoiceError,
)
from cvqmpt_lab.base.files import (
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
    return sorted(path.name for path in folder.iterdir())


def test_a_full_disk_keeps_the_old_file_and_leaves_no_other(tmp_path, monkeypatch):
    write_bytes(tmp_path / "a", b"old")

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    refused(r"cannot write .*/a: No space left", write_bytes, tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"old"
    assert names(tmp_path) == ["a"]


def test_a_link_is_followed(tmp_path):
    (tmp_path / "link").symlink_to("target")
    write_bytes(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "target").read_bytes() == b"new"


def test_a_file_whose_writing_fails_is_not_moved_into_place(tmp_path):
    with pytest.raises(RuntimeError), replacing(tmp_path / "film.gif") as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert names(tmp_path) == []


def test_locking_a_folder_removes_temporary_files_of_killed_writers_and_nothing_else(tmp_path):
    (tmp_path / "shards").mkdir()
    with replacing(tmp_path / "shards" / "a.npz") as temporary:
        temporary.touch()
    temporary.write_text("half")
    (tmp_path / "shards" / "a.npz").unlink()
    for name in ("a.npz", ".mine.tmp", ".git"):
        (tmp_path / name).write_text("whole")
    with locked(tmp_path):
        assert names(tmp_path) == [".git", ".mine.tmp", "a.npz", "shards"]
        assert names(tmp_path / "shards") == []


@pytest.mark.parametrize(
    ("use", "words"),
    [
        (lambda p: read_text(p / "absent", "task"), "cannot read task .*/absent: No such file"),
        (lambda p: read_text(p / "latin"), r"file .*/latin is not UTF-8 text \(byte 0\)"),
        (lambda p: write_text(p / "latin" / "below", ""), "cannot write .*/below: Not a directory"),
        (lambda p: write_bytes(p / "pipe", b""), "write file .*/pipe: it is not a regular file"),
        (lambda p: make_folder(p / "latin"), "cannot make folder .*/latin: File exists"),
        (lambda p: read_json_object("/dev/zero", "scene"), "/dev/zero: it is not a regular file"),
        (lambda p: json_value('{"a": 1, "a": {}}', "x"), "key 'a' occurs twice"),
        (lambda p: json_value(r'{"a": ["\uD800"]}', "x"), r"x is not json: .*surrogates"),
        (lambda p: json_value("<html>", "x"), "is not json"),
        (lambda p: json_value("[" * 100_000, "x"), "is not json"),
    ],
)
def test_a_file_that_cannot_be_read_or_written_is_named(tmp_path, use, words):
    (tmp_path / "latin").write_bytes(b"\xe9")
    os.mkfifo(tmp_path / "pipe")
    refused(words, use, tmp_path)


@pytest.mark.parametrize("name", ["a\0b", "a\ud800", "x" * 5000])
def test_a_name_that_no_file_can_have_is_refused(tmp_path, name):
    path = tmp_path / name
    refused("cannot read scan", lambda: read_bytes(require_regular_file(path, "scan"), "scan"))


@pytest.mark.parametrize(
    "error",
    [
        InvalidInputError(f"cannot read scene {'x' * 9000}: File name too long; choose another"),
        RunStoreError("a\nb\x1b[31m\ud800; choose another"),
        UnknownChoiceError("thing", "é\n" * 5000, ["a" * 3000, "another"]),
    ],
)
def test_an_error_is_one_printable_line_that_keeps_its_end(error):
    assert str(error).isprintable() and len(str(error)) <= MAX_MESSAGE_CHARACTERS
    assert "another" in str(error)[-60:]
    str(error).encode()
    arrived = pickle.loads(pickle.dumps(error))  # workers send errors like this
    assert type(arrived) is type(error) and str(arrived) == str(error)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Cache folder with one file, made with a group-writable umask, before any warning."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setattr(caches, "_CACHE_WARNING", threading.Event())
    before = os.umask(0o002)
    place = trusted_cache(tmp_path / "own" / "cache" / "things")
    os.umask(before)
    assert place == tmp_path / "own" / "cache" / "things"
    (place / "file").touch(0o644)
    return place


@pytest.mark.parametrize(
    ("folder", "mode"), [("", 0o755), ("", 0o555), ("../..", 0o1777), ("..", 0o700)]
)
def test_a_cache_that_only_its_user_can_change_is_used(cache, recwarn, folder, mode):
    (cache / folder).chmod(mode)
    assert trusted_cache(cache) == cache and not recwarn.list


@pytest.mark.parametrize(
    ("path", "mode"),
    [("", 0o777), ("", 0o775), ("", 0o1777), ("..", 0o777), ("../..", 0o770), ("file", 0o664)],
)
def test_a_cache_that_others_can_change_is_replaced_by_a_private_one_with_one_warning(
    cache, recwarn, path, mode
):
    (cache / path).chmod(mode)
    instead = trusted_cache(cache)
    assert instead == trusted_cache(cache) and str(instead).startswith(tempfile.gettempdir())
    assert instead.stat().st_mode & 0o022 == 0 and list(instead.iterdir()) == []
    (warning,) = recwarn.list
    message = str(warning.message)
    assert "others can write" in message and str(instead) in message
    instead.chmod(0o777)
    assert trusted_cache(cache) is None and len(recwarn.list) == 1


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give files away")
@pytest.mark.parametrize("path", ["", "file", ".."])
def test_a_cache_of_another_user_is_not_used(cache, recwarn, path):
    os.chown(cache / path, 12345, -1)
    assert trusted_cache(cache) != cache
    assert "another user (id 12345)" in str(recwarn.list[0].message)


def test_without_a_cache_folder_a_temporary_one_is_used_and_without_that_none(
    cache, recwarn, tmp_path, monkeypatch
):
    """No user, not even root, can make a folder below a file."""
    for temporary in (tmp_path / "temporary", cache / "file"):
        monkeypatch.setattr(tempfile, "tempdir", str(temporary))
        monkeypatch.setattr(caches, "_CACHE_WARNING", threading.Event())
        found = trusted_cache(cache / "file" / "below")
        message = str(recwarn.pop(UserWarning).message)
        assert f"{cache}/file/below is not writable" in message
        assert "set XDG_CACHE_HOME and NUMBA_CACHE" in message
        nowhere = temporary == cache / "file"
        assert (found is None) == ("everything is computed again" in message) == nowhere


@pytest.mark.parametrize(("named", "kept"), [("", "~/.cache"), ("here", "here"), ("/a/b", "/a/b")])
def test_the_environment_variable_sets_the_cache_folder(tmp_path, monkeypatch, named, kept):
    monkeypatch.setenv("XDG_CACHE_HOME", named)
    monkeypatch.chdir(tmp_path)
    assert cache_folder() == tmp_path / Path(kept).expanduser() / "cvqmpt_lab"


def test_a_cache_folder_of_an_unknown_user_is_refused(monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "~nouser/x")
    refused("XDG_CACHE_HOME: no folder '~nouser/x'", cache_folder)


def test_a_byte_order_mark_is_no_text_and_an_empty_file_no_object(tmp_path):
    (tmp_path / "a.json").write_text('{"a": 1}', encoding="utf-8-sig")
    assert read_json_object(tmp_path / "a.json") == {"a": 1}
    (tmp_path / "a.json").write_text(" // nothing\n")
    refused("a.json is empty; write one object", read_json_object, tmp_path / "a.json")


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("tool.STL", "is a mesh; name it in a problem file"),
        ("scan.pcd", "is a cloud; write a scene from it with: cvqmpt scan scan.pcd --out"),
        ("path.csv", "is a motion; judge it with: cvqmpt certify path.csv PROBLEM.json"),
    ],
)
def test_a_file_of_another_kind_is_named_with_its_use(tmp_path, name, told):
    (tmp_path / name).write_bytes(b"solid \xff")
    refused(
        f"{name}, given as problem file, {told}", read_json_object, tmp_path / name, "problem file"
    )
    (tmp_path / "mine.json").write_bytes(b"\xff")
    refused("is not UTF-8 text", read_json_object, tmp_path / "mine.json", "problem file")
