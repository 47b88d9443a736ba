"""Motions in recordings of ROS 2: an MCAP or sqlite file, or a folder of rosbag2 with such files.

The library rosbags would read both, but unpacks chunks of any size, where the index of an MCAP file
says; here they are bounded first. The messages in sqlite are decoded by the library for MCAP.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from cvqmpt_lab.base.errors import InvalidInputError, require_choice, require_installed, shown

MAX_CHUNK = 2**28  # unpacked [bytes]; rosbag2 writes chunks of 0.8 MB, and larger for one image
MOTIONS = ("JointTrajectory", "RobotTrajectory", "DisplayTrajectory")
SUFFIXES = (".mcap", ".db3")
# sqlite files before ROS 2 Iron hold no definitions of their messages
LINE = "=" * 80
JOINT_TRAJECTORY = f"""
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint[] points
{LINE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{LINE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
{LINE}
MSG: trajectory_msgs/JointTrajectoryPoint
float64[] positions
float64[] velocities
float64[] accelerations
float64[] effort
builtin_interfaces/Duration time_from_start
{LINE}
MSG: builtin_interfaces/Duration
int32 sec
uint32 nanosec
"""
UNKNOWN_SIZES = (2**64 - 1, 2**64 - 2)  # of a zstd frame, as its library states them


class Found(NamedTuple):
    """A message of a recording."""

    topic: str
    kind: str  # without the package
    time: int  # at which it was recorded [ns]
    content: Any  # decoded; None: it is no motion


def is_bag(path: Path) -> bool:
    """Return whether a path is a file of a recording or a folder of rosbag2."""
    return path.suffix in SUFFIXES or (path / "metadata.yaml").is_file()


def message_of_bag(path: Path, topic: str | None = None) -> Any:
    """Return the last message of a topic with motions, as plain values.

    Args:
        path: file or folder.
        topic: name of the topic; None: the only one with motions.

    Raises InvalidInputError without the package mcap-ros2-support, and for a recording without the
    topic; the message names those that it has.
    """
    require_installed("mcap_ros2", f"reading {path}", "ros")
    files = [path] if path.is_file() else sorted(map(path.joinpath, _names(path)))
    if not files:
        held = ", ".join(sorted(file.name for file in path.iterdir())) if path.is_dir() else "-"
        raise InvalidInputError(
            f"{path} has no file {' or '.join(SUFFIXES)} ({held}); convert it by: ros2 bag "
            "convert, with storage_id mcap, unpack it by: zstd -d"
        )
    last = dict[str, Any]()
    times = dict[str, int]()
    others = dict[str, str]()
    try:
        for file in files:
            for name, kind, time, content in _messages(file):
                if content is None:
                    others[name] = kind
                # the order of files is not that of times: rec_10 comes before rec_2
                elif time >= times.get(name, time):
                    last[name], times[name] = content, time
    except InvalidInputError as error:
        raise InvalidInputError(f"recording {path}: {error}") from error
    except Exception as error:  # mcap, zstandard, lz4 and sqlite3 have errors of their own
        raise InvalidInputError(f"cannot read recording {path}: {shown(str(error))}") from error
    if not last:
        listed = ", ".join(f"{name} ({kind})" for name, kind in others.items()) or "none"
        raise InvalidInputError(
            f"{path} has no topic with a {', '.join(MOTIONS)}; its topics: {listed}"
        )
    if topic is None and len(last) > 1:
        raise InvalidInputError(f"{path} has motions on {', '.join(last)}: choose one by --topic")
    name = next(iter(last)) if topic is None else require_choice("topic", topic, last)
    return _plain(last[name])


def _names(folder: Path) -> list[str]:
    """Return the names of the files of a recording in a folder; none if there is no folder."""
    names = [file.name for file in folder.iterdir()] if folder.is_dir() else []
    return [name for name in names if Path(name).suffix in SUFFIXES]


def _messages(file: Path) -> Iterator[Found]:
    """Yield the messages of a file; of sqlite the last ones of each topic."""
    yield from _of_sqlite(file) if file.suffix == ".db3" else _of_mcap(file)


def _of_mcap(file: Path) -> Iterator[Found]:
    """Yield the messages of an MCAP file in its order; first the sizes of its chunks are checked.

    The index of the file is not used: it could point at chunks that were not checked.
    """
    from mcap.reader import NonSeekingReader
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader
    from mcap_ros2.decoder import DecoderFactory
    from mcap_ros2.reader import read_ros2_messages

    with file.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Chunk) and (size := _unpacked_size(record)) > MAX_CHUNK:
                raise InvalidInputError(
                    f"a chunk of it unpacks to {size} bytes or more, at most {MAX_CHUNK} are read: "
                    "record it again with smaller chunks"
                )
        stream.seek(0)
        reader = NonSeekingReader(stream, decoder_factories=[DecoderFactory()])
        for found in read_ros2_messages(reader, log_time_order=False):
            kind = found.schema.name.rpartition("/")[2]
            content = found.ros_msg if kind in MOTIONS else None
            yield Found(found.channel.topic, kind, found.log_time_ns, content)


def _of_sqlite(file: Path) -> Iterator[Found]:
    """Yield the last message of each topic of a sqlite file of rosbag2."""
    import sqlite3
    from contextlib import closing

    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory

    # immutable: no file is made beside it, and none there is read
    address = f"{file.absolute().as_uri()}?mode=ro&immutable=1"
    with closing(sqlite3.connect(address, uri=True)) as base:
        tables = {name for (name,) in base.execute("SELECT name FROM sqlite_master")}
        texts = {"trajectory_msgs/msg/JointTrajectory": JOINT_TRAJECTORY}
        if "message_definitions" in tables:
            rows = "SELECT topic_type, encoded_message_definition FROM message_definitions"
            texts |= {kind: text for kind, text in base.execute(rows) if text}
        topics = base.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        for number, topic, kind, encoding in topics:
            short = str(kind).rpartition("/")[2]
            if short not in MOTIONS:
                yield Found(topic, short, 0, None)
                continue
            if kind not in texts:
                raise InvalidInputError(
                    f"it does not say what a {kind} is, on topic {topic}: convert it by: ros2 bag "
                    "convert, with storage_id mcap"
                )
            latest = "FROM messages WHERE topic_id = ? ORDER BY timestamp DESC, id DESC LIMIT 1"
            for size, time in base.execute(f"SELECT length(data), timestamp {latest}", (number,)):
                if size > MAX_CHUNK:
                    raise InvalidInputError(
                        f"a message of it has {size} bytes, at most {MAX_CHUNK} are read"
                    )
                ((data,),) = base.execute(f"SELECT data {latest}", (number,))
                schema = Schema(id=1, name=kind, encoding="ros2msg", data=texts[kind].encode())
                decode = DecoderFactory().decoder_for(encoding, schema)
                if decode is None:
                    raise InvalidInputError(f"topic {topic} is written in {shown(encoding)}")
                yield Found(topic, short, time, decode(data))


def _unpacked_size(chunk: Any) -> int:
    """Return the size of a chunk when it is unpacked [bytes], at most a little above the bound."""
    size = int(chunk.uncompressed_size)
    if chunk.compression == "zstd":
        import zstandard  # comes with mcap

        stated = zstandard.get_frame_parameters(chunk.data).content_size
        # without a size in the frame, at most the size of the chunk's header is unpacked
        size = size if stated in UNKNOWN_SIZES else max(size, stated)
    elif chunk.compression == "lz4" and size <= MAX_CHUNK:
        import lz4.frame  # comes with mcap

        unpacked = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, MAX_CHUNK + 1)
        size = max(size, len(unpacked))
    return size


def _plain(value: Any) -> Any:
    """Return a decoded message as mappings, lists and numbers."""
    if isinstance(value, str | bytes | int | float):
        return value
    if hasattr(value, "__slots__"):
        return dict(_fields(value))
    return [_plain(item) for item in value]


def _fields(message: Any) -> Iterator[tuple[str, Any]]:
    for name in message.__slots__:
        yield name, _plain(getattr(message, name))
