"""Guard of the studio's page: which browsers may connect to it, and what they may send.

viser checks neither. Without a guard, any page that is open in the same browser, and any user of
the computer, could read the problem, set attributes of viser's objects or open its public tunnel.
"""

import math
import secrets
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any


class Guard:
    """Guard of one server of viser: everything that is not permitted here is dropped.

    `values` has the check of a new value by the uuid of each element, `gizmos` the names of what
    can be dragged, `clicked` the names of what can be clicked.
    """

    def __init__(self) -> None:
        self.token = secrets.token_urlsafe(24)  # the path of the page's address
        self.values: dict[str, Callable[[Any], bool]] = {}
        self.gizmos: set[str] = set()
        self.clicked: set[str] = set()
        self.started = False

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Guard the server that is started meanwhile; `started` says whether there was one."""
        import websockets.asyncio.server as sockets
        from websockets.datastructures import Headers
        from websockets.http11 import Request, Response

        guard, original = self, sockets.serve

        class Connection(sockets.ServerConnection):
            """Connection that receives permitted messages only."""

            async def recv(self, *args: Any, **settings: Any) -> Any:
                message = await super().recv(*args, **settings)
                while not guard.permits(message):
                    message = await super().recv(*args, **settings)
                return message

        def serve(*args: Any, process_request: Any, **settings: Any) -> Any:
            def answer(connection: Any, request: Request) -> Any:
                headers = request.headers
                upgrade = "Upgrade" in headers
                hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
                if not guard.admits(request.path, hosts, origins, upgrade):
                    return Response(403, "Forbidden", Headers(), b"")
                return process_request(connection, Request("/", headers))

            guard.started = True
            most = 2**16  # of bytes in a message; the page sends some hundred
            settings |= {"max_size": most, "create_connection": Connection}
            return original(*args, process_request=answer, **settings)

        sockets.serve = serve  # type: ignore[misc, assignment]
        try:
            yield
        finally:
            sockets.serve = original  # type: ignore[misc]

    def admits(self, path: str, hosts: list[str], origins: list[str], upgrade: bool) -> bool:
        """Check a request: token, a local Host, and the page itself as Origin of a web socket.

        Args:
            path: path and query of the request.
            hosts: all its headers Host; a foreign name would be another site's that leads here.
            origins: all its headers Origin.
            upgrade: whether it asks for a web socket, for which browsers always send an Origin.
        """
        token = path.partition("?")[0].strip("/")
        own = secrets.compare_digest(token.encode(), self.token.encode())
        local = len(hosts) == 1 and hosts[0].partition(":")[0] in ("127.0.0.1", "localhost")
        same = all(origin == f"http://{hosts[0]}" for origin in origins) if local else False
        return own and local and same and len(origins) == upgrade

    def permits(self, message: Any) -> bool:
        """Check a message of the page: its kind, its fields and every value."""
        import msgspec

        try:
            fields = msgspec.msgpack.decode(message)
        except (msgspec.DecodeError, TypeError):
            return False
        if not isinstance(fields, dict):
            return False
        kind = fields.pop("type", None)
        fields.pop("excluded_self_client", None)
        if kind == "GuiUpdateMessage":
            return self._permits_value(fields)
        if kind == "ViewerCameraMessage":
            return all(is_number(value) or _are_numbers(value) for value in fields.values())
        name, owner = fields.pop("name", None), fields.pop("owner", "")
        if not isinstance(name, str) or name not in self.gizmos | self.clicked or owner != "":
            return False
        if kind == "SceneNodeClickMessage":
            rays = [fields.pop(key, None) for key in ("ray_origin", "ray_direction")]
            at = fields.pop("screen_pos", None)
            plain = fields == {"instance_index": None, "modifier": None}
            return plain and all(_are_numbers(ray, 3) for ray in rays) and _are_numbers(at, 2)
        if name not in self.gizmos:
            return False
        if kind == "TransformControlsUpdateMessage":
            rotation, position = fields.get("wxyz"), fields.get("position")
            if not (_are_numbers(rotation, 4) and _are_numbers(position, 3) and len(fields) == 2):
                return False
            return math.hypot(*fields["wxyz"]) > 0.5  # a quaternion has length 1
        drags = ("TransformControlsDragStartMessage", "TransformControlsDragEndMessage")
        return kind in drags and not fields

    def _permits_value(self, fields: Mapping[str, Any]) -> bool:
        """Check the new value of an element, which is all that a page may change of it."""
        uuid, updates = fields.get("uuid"), fields.get("updates")
        if len(fields) != 2 or not isinstance(uuid, str) or uuid not in self.values:
            return False
        if not isinstance(updates, dict) or updates.keys() != {"value"}:
            return False
        return self.values[uuid](updates["value"])


def is_number(value: Any, least: float = -1e6, most: float = 1e6) -> bool:
    """Check for a number from `least` to `most`; NaN is none."""
    return isinstance(value, float | int) and type(value) is not bool and least <= value <= most


def is_choice(value: Any, choices: tuple[str, ...]) -> bool:
    """Check for one of some names."""
    return isinstance(value, str) and value in choices


def is_switch(value: Any) -> bool:
    """Check for true or false."""
    return isinstance(value, bool)


def _are_numbers(value: Any, count: int | None = None) -> bool:
    """Check for a list of so many numbers, or of at most four."""
    if not isinstance(value, list) or not len(value) <= 4 or count not in (None, len(value)):
        return False
    return all(map(is_number, value))
