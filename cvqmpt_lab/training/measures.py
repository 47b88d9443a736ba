"""Values measured on held-out paths, batch by batch."""


class Measures:
    """Means over several batches."""

    def __init__(self) -> None:
        self._sums: dict[str, list[float]] = {}

    def add(self, name: str, total: float, count: float) -> None:
        """Take in a sum over `count` values."""
        earlier = self._sums.setdefault(name, [0.0, 0.0])
        earlier[0] += total
        earlier[1] += count

    def values(self) -> dict[str, float | None]:
        """Each mean; None where nothing tells it."""
        return {name: total / count if count else None for name, (total, count) in self._sums.items()}
