"""Motions in recordings of ROS 2: an MCAP file, or a folder that rosbag2 wrote with MCAP files."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cvqmpt_lab.base.errors import InvalidInputError, require_choice, require_installed, shown

MAX_CHUNK = 2**28  # unpacked [bytes]; rosbag2 writes chunks of 0.8 MB, and larger for one image
UNKNOWN_SIZES = (2**64 - 1, 2**64 - 2)  # of a zstd frame, as its library states them


def is_bag(path: Path) -> bool:
    """Return whether a path is an MCAP file or a folder of rosbag2."""
    return path.suffix == ".mcap" or (path / "metadata.yaml").is_file()


def message_of_bag(path: Path, topic: str | None = None) -> Any:
    """Return the last message of a topic with motions, as plain values.

    Args:
        path: file or folder.
        topic: name of the topic; None: the only one with motions.

    Raises InvalidInputError without the package mcap-ros2-support, and for a recording without the
    topic; the message names those that it has.
    """
    require_installed("mcap_ros2", f"reading {path}", "ros")
    motions = ("JointTrajectory", "RobotTrajectory", "DisplayTrajectory")
    files = [path] if path.is_file() else sorted(path.glob("*.mcap"))
    if not files:
        held = ", ".join(sorted(file.name for file in path.iterdir())) if path.is_dir() else "-"
        raise InvalidInputError(
            f"{path} has no .mcap file ({held}); convert it by: ros2 bag convert, with "
            "storage_id mcap"
        )
    last = dict[str, Any]()
    times = dict[str, int]()
    others = dict[str, str]()
    try:
        for file in files:
            for found in _messages(file):
                kind = found.schema.name.rpartition("/")[2]
                name, time = found.channel.topic, found.log_time_ns
                if kind not in motions:
                    others[name] = kind
                # the order of files is not that of times: rec_10 comes before rec_2
                elif time >= times.get(name, time):
                    last[name], times[name] = found.ros_msg, time
    except InvalidInputError as error:
        raise InvalidInputError(f"recording {path}: {error}") from error
    except Exception as error:  # mcap, zstandard and lz4 have errors of their own
        raise InvalidInputError(f"cannot read recording {path}: {shown(str(error))}") from error
    if not last:
        listed = ", ".join(f"{name} ({kind})" for name, kind in others.items()) or "none"
        raise InvalidInputError(
            f"{path} has no topic with a {', '.join(motions)}; its topics: {listed}"
        )
    if topic is None and len(last) > 1:
        raise InvalidInputError(f"{path} has motions on {', '.join(last)}: choose one by --topic")
    name = next(iter(last)) if topic is None else require_choice("topic", topic, last)
    return _plain(last[name])


def _messages(file: Path) -> Iterator[Any]:
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
        yield from read_ros2_messages(reader, log_time_order=False)


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
