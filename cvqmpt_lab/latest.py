"""The latest few of what is slow to make, in memory."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Made = TypeVar("Made")


class Latest(Generic[Made]):
    """What was made for the keys that were asked for last."""

    def __init__(self, most: int) -> None:
        self._most, self._made = most, OrderedDict[Hashable, Made]()

    def get(self, key: Hashable, make: Callable[[], Made], use_cache: bool = True) -> Made:
        """What was made for a key, or is now; without `use_cache` it is made again."""
        if not use_cache or key not in self._made:
            self._made[key] = make()
            if len(self._made) > self._most:
                self._made.popitem(last=False)
        self._made.move_to_end(key)
        return self._made[key]
