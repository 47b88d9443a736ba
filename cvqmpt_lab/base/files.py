"""Read and write files: writing replaces a file completely or not at all; errors name the path."""

from __future__ import annotations

import contextlib
import csv
import fcntl
import functools
import importlib
import io
import json
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cvqmpt_lab.base.errors import InvalidInputError, nearest, require_choice, shown

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; its file is moved to `path` at the end.

    After an error `path` is unchanged, and InvalidInputError names the reason. Symbolic links are
    followed.
    """
    path = Path(path)
    if path.is_symlink():
        path = path.resolve()
    require_regular_file(path, "file", "write")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise InvalidInputError(
            f"cannot write {path}: {error.strerror}; choose a writable folder"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def picture_format(path: Path) -> str:
    """Format of a picture by the suffix of its file, in Pillow's words; other suffixes raise."""
    formats = {".png": "PNG", ".jpg": "JPEG", ".pdf": "PDF"}
    return formats[require_choice(f"picture {path}: suffix", path.suffix.lower(), formats)]


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file as `replacing` does, and wait until it is on the disk."""
    with replacing(path) as temporary, temporary.open("wb") as handle:
        handle.write(data)
        handle.flush()
        os.fsync(handle.fileno())


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text as `write_bytes` does."""
    write_bytes(path, text.encode("utf-8"))


def make_folder(path: Path) -> Path:
    """Make a folder with its parents if it does not exist; errors name it."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"cannot make folder {path}: {error.strerror}; choose a writable one"
        ) from error
    return Path(path)


def require_regular_file(path: Path, what: str = "file", use: str = "read") -> Path:
    """Return the path; refuse pipes (a reader would wait) and devices (they may have no end)."""
    path = Path(path)
    try:
        odd = path.exists() and not path.is_file() and not path.is_dir()
    except OSError as error:  # e.g. a name that is too long
        raise InvalidInputError(f"cannot {use} {what} {path}: {error.strerror}") from error
    if odd:
        raise InvalidInputError(f"cannot {use} {what} {path}: it is not a regular file")
    return path


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder's advisory lock during the block; refuse a folder that another process locks.

    Temporary files that killed processes left in the folder are removed.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        # some file systems have no locks: go on without
        with contextlib.suppress(OSError):
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InvalidInputError(
                    f"{folder} is in use by another run; wait or use another folder"
                ) from None
            for path in Path(folder).rglob(".*.tmp"):
                if re.fullmatch(r"\..+\.\d+\.tmp", path.name):  # names made by `replacing`
                    path.unlink(missing_ok=True)
        yield
    finally:
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_UN)  # explicit: forked workers may still hold the handle
        os.close(handle)


def read_bytes(path: Path, what: str = "file") -> bytes:
    """Read a file; errors call it `what` and name its path."""
    path = require_regular_file(path, what)
    try:
        return path.read_bytes()
    except OSError as error:
        near = ""
        if isinstance(error, FileNotFoundError) and path.parent.is_dir():
            near = nearest(path.name, (other.name for other in path.parent.iterdir()))
        raise InvalidInputError(f"cannot read {what} {path}: {error.strerror}{near}") from error
    except ValueError as error:  # e.g. a null character in the name
        raise InvalidInputError(f"cannot read {what} {shown(str(path))}: {error}") from error


# what a file is by its suffix where another kind was expected, and how to use it; {} is its name
OTHER_KINDS = {
    **dict.fromkeys(
        (".stl", ".obj", ".dae", ".glb", ".off"),
        'a mesh; name it in a problem file: "shape": {{"type": "mesh_file", "path": "{0}"}}',
    ),
    **dict.fromkeys(
        (".pcd", ".ply", ".xyz", ".npy", ".las"),
        "a cloud; write a scene from it with: cvqmpt scan {0} --out scene.json",
    ),
    **dict.fromkeys(
        (".png", ".tif", ".tiff", ".exr"),
        "an image; write a scene from a depth image with: cvqmpt scan {0} --out scene.json",
    ),
    **dict.fromkeys(
        (".csv", ".npz", ".mcap"), "a motion; judge it with: cvqmpt certify {0} PROBLEM.json"
    ),
}


def _refuse_other_kind(path: Path, what: str) -> None:
    """Refuse a file whose suffix says that it is no `what` but a mesh, a cloud or a motion."""
    path = Path(path)
    told = OTHER_KINDS.get(path.suffix.lower())
    if told is not None and path.is_file():
        raise InvalidInputError(f"{path}, given as {what}, is {told.format(path.name)}")


def read_text(path: Path, what: str = "file") -> str:
    """Read UTF-8 text as `read_bytes` does, without a byte order mark."""
    try:
        return read_bytes(path, what).decode().removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        _refuse_other_kind(path, what)
        raise InvalidInputError(f"{what} {path} is not UTF-8 text (byte {error.start})") from error


def read_xml(path: Path, what: str = "file") -> Element:
    """Return the root of an XML file as programs of ROS read it; errors name the path.

    Names keep their prefixes, bound or not, and a default namespace has no effect. A byte order
    mark, blanks or comments may precede the declaration.
    """
    return xml_root(read_text(path, what), f"{what} {path}")


def xml_root(text: str, what: str) -> Element:
    """Return the root of an XML text as `read_xml` does; errors call the text `what`."""
    from xml.etree.ElementTree import TreeBuilder  # imported here: most runs read no such file
    from xml.parsers import expat

    def refuse_entity(name: str, *definition: Any) -> None:
        raise InvalidInputError(
            f"cannot read {what}: it declares the entity {shown(name)}, which could grow without "
            "limit; write its value out"
        )

    builder, parser = TreeBuilder(), expat.ParserCreate()
    parser.EntityDeclHandler = refuse_entity
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    text = text.lstrip("\ufeff \t\r\n")
    after = 0
    while text.startswith("<!--", after) and (end := text.find("-->", after)) >= 0:
        blanks = re.compile(r"\s*").match(text, end + 3)
        after = blanks.end() if blanks else end + 3
    if text.startswith("<?xml", after):
        text = text[after:]
    try:
        parser.Parse(text, True)
        return builder.close()
    except expat.ExpatError as error:
        raise InvalidInputError(f"cannot read {what}: {error}") from error


def read_json_object(path: Path, what: str = "file") -> dict[str, Any]:
    """Read a file that holds one JSON object."""
    _refuse_other_kind(path, what)
    return json_object(read_text(path, what), f"{what} {path}")


def json_object(text: str, what: str) -> dict[str, Any]:
    """Return the JSON object of a text; comments and a comma after the last item are allowed."""
    try:
        data = json_value(text, what)
    except InvalidInputError:
        plain = _without_comments(text)
        begin = plain.strip().partition("\n")[0][:20]
        if not begin:
            raise InvalidInputError(f"{what} is empty; write one object, {{...}}") from None
        if begin[0] not in "{[":
            cure = f'it begins with {begin!r}; write one object, {{"name": value, ...}}'
            raise InvalidInputError(f"{what} is not json: {cure}") from None
        if plain == text:
            raise
        data = json_value(plain, what)
    if not isinstance(data, dict):
        raise InvalidInputError(f"{what} must hold one json object")
    return data


def _without_comments(text: str) -> str:
    """Return JSON text with spaces for comments (//, /* */, #) and commas after a last item."""

    def blank(found: re.Match[str]) -> str:
        return found[0] if found[0][0] == '"' else re.sub(r"[^\n]", " ", found[0])

    string = r'"(?:\\.|[^"\\\n])*"'
    text = re.sub(rf"{string}|//[^\n]*|#[^\n]*|/\*(?s:.*?)\*/", blank, text)
    return re.sub(rf"{string}|,(?=\s*[\]}}])", blank, text)


def json_value(text: str, what: str) -> Any:
    """Return the value of a JSON text; refuse a repeated key and half of a surrogate pair."""
    try:
        value = json.loads(text, object_pairs_hook=_unique_keys)
        # half of a surrogate pair cannot be written to a file
        if "\\ud" in text.lower():
            json.dumps(value, ensure_ascii=False).encode("utf-8")
        return value
    except (ValueError, RecursionError) as error:  # not JSON, or nested too deeply
        raise InvalidInputError(f"{what} is not json: {error}") from error


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data = dict(pairs)
    if len(data) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"key {shown(twice)} occurs twice in one object")
    return data


def finite(value: Any) -> Any:
    """Return the value with None in place of NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return [finite(item) for item in value] if isinstance(value, list) else value


def json_text(plain: Any, indent: int = 0, line: int = 120) -> str:
    """Return indented JSON text; short values, rows of numbers and matrices are on one line.

    Args:
        plain: the value.
        indent: number of spaces before the value.
        line: longest line [characters] of a value that is not split.
    """
    flat = json.dumps(plain, allow_nan=False)
    if not isinstance(plain, dict | list) or len(flat) + indent <= line or _is_row(plain):
        return flat
    if isinstance(plain, dict):
        opening, closing = "{", "}"
        lines = [
            f"{json.dumps(key)}: {json_text(item, indent + 1, line)}" for key, item in plain.items()
        ]
    else:
        opening, closing = "[", "]"
        lines = [json_text(item, indent + 1, line) for item in plain]
    pad = "\n" + " " * (indent + 1)
    return opening + pad + f",{pad}".join(lines) + pad[:-1] + closing


def _is_row(plain: Any) -> bool:
    """Return whether a value is a list of numbers or a small matrix."""
    if not isinstance(plain, list):
        return False
    rows = [item for item in plain if not isinstance(item, float | int | None)]
    small = (
        all(isinstance(row, list) and _is_row(row) for row in rows) and sum(map(len, rows)) <= 16
    )
    return not rows or (small and len(rows) == len(plain))


def csv_table(lines: Iterable[Iterable[object]]) -> str:
    """Return CSV text of lines of cells; None becomes an empty cell."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()


YAML_UNITS: Mapping[str, float] = {
    "!degrees": math.pi / 180.0,
    "!radians": 1.0,
    "!millimeters": 1e-3,
    "!meters": 1.0,
    "!inches": 0.0254,
    "!foot": 0.3048,
}
"""Tags of xacro and rosparam for numbers, with the size of their unit [rad or m]."""


def yaml_value(text: str) -> Any:
    """Return the value of a YAML text; refuse tags, aliases and repeated keys.

    Read are the tags of units, as xacro reads them, and the matrices and first line of OpenCV's
    FileStorage. Nested aliases could need unlimited memory. Marks of the end, as `ros2 topic echo`
    prints them, are ignored. InvalidInputError names line and column of malformed text.
    """
    import yaml  # imported here: most runs read no such file

    text = re.sub(r"\A\ufeff?%YAML:1\.[0-9][ \t]*\r?\n", "", text)
    text = re.sub(r"(?m)(^(---|\.\.\.)[ \t]*\r?\n?)+\Z", "", text)
    try:
        return yaml.load(text, _yaml_loader())
    except yaml.MarkedYAMLError as error:
        said = str(error.problem or error.context)
        if "single document" in str(error):
            said = (
                "it has more than a single document; keep one, and remove the others with their "
                "'---'"
            )
        elif "could not determine a constructor" in said:
            tag = said.rpartition("tag ")[2].strip("'").replace("tag:yaml.org,2002:", "!!")
            said = f"the tag {tag} is not read; write the value without it"
        elif "unhashable key" in said:
            said = "a key is a list or a mapping; write a name"
        elif r"'\t'" in said:
            said = "a tab; indent by blanks"
        mark = error.problem_mark or error.context_mark
        place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise InvalidInputError(f"{place}{said}") from error
    except InvalidInputError:
        raise
    except RecursionError as error:
        raise InvalidInputError("lists or mappings are nested too deeply") from error
    except Exception as error:  # yaml's own types raise all kinds of errors
        said = " ".join(str(error).split())[:200]
        raise InvalidInputError(f"it has a value that is none of its type: {said}") from error


@functools.cache
def _yaml_loader() -> type:
    """Return the loader of `yaml_value`."""
    import yaml

    class Loader(yaml.SafeLoader):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise InvalidInputError("it has an alias (*name); write the value out")
            return super().compose_node(parent, index)

        def construct_mapping(self, node: Any, deep: bool = False) -> dict:
            keys = [self.construct_object(key) for key, _ in node.value]
            twice = next((key for k, key in enumerate(keys) if key in keys[:k]), None)
            if twice is not None:
                raise InvalidInputError(f"key {twice!r} occurs twice")
            return super().construct_mapping(node, deep)

    def with_unit(loader: Any, node: Any) -> float:
        number = loader.construct_scalar(node)
        try:
            return float(number) * YAML_UNITS[node.tag]
        except (TypeError, ValueError) as error:
            raise InvalidInputError(
                f"{node.tag} has {shown(number)}; write a number, such as {node.tag} 90.0"
            ) from error

    for tag in YAML_UNITS:
        Loader.add_constructor(tag, with_unit)
    Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", Loader.construct_yaml_map)
    # YAML 1.1 reads 1e-3 as text
    number = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", number, list("-+.0123456789"))
    return Loader


def differences(before: object, now: object, name: str = "") -> list[str]:
    """Describe every setting in which two JSON values differ, nested ones by dotted name."""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return [] if before == now else [f"{name} was {json.dumps(before)}, now {json.dumps(now)}"]
    found = []
    for key in sorted(before.keys() | now.keys()):
        found += differences(before.get(key), now.get(key), f"{name}.{key}" if name else key)
    return found


class Modules(Mapping[str, Any]):
    """Modules of a folder by name, in order of the names; each is imported when it is used.

    The name of a module is that of its file without an ending, and with - in place of _.
    """

    def __init__(self, folder: str, ending: str = "") -> None:
        """Find the files `folder`/NAME`ending`.py of this package."""
        self._package = f"cvqmpt_lab.{folder.replace('/', '.')}"
        files = (Path(__file__).parents[1] / folder).glob(f"[!_]*{ending}.py")
        stems = sorted(path.stem for path in files)
        self._stems = {stem.removesuffix(ending).replace("_", "-"): stem for stem in stems}

    def __getitem__(self, name: str) -> Any:
        return importlib.import_module(f"{self._package}.{self._stems[name]}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._stems)

    def __len__(self) -> int:
        return len(self._stems)


@dataclass(frozen=True)
class Imported:
    """A function of a module that is imported when the function is first called."""

    name: str  # MODULE:FUNCTION

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Call the function."""
        module, _, function = self.name.partition(":")
        return getattr(importlib.import_module(module), function)(*arguments, **options)
