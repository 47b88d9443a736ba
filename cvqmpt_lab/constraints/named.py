"""Regions as problem files state them: in full, or by one of a few names with parameters.

A new name is a file in `by_name` with the function of this name and an example of its fields.
"""

import json
import typing
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from cvqmpt_lab.base.codec import field_defaults, field_kinds, from_plain
from cvqmpt_lab.base.errors import (
    InvalidInputError,
    at,
    mapping,
    nearest,
    require_choice,
    shown,
)
from cvqmpt_lab.base.files import Modules
from cvqmpt_lab.base.values import Name
from cvqmpt_lab.constraints.task_space_region import (
    Axis,
    TaskSpaceRegion,
    TaskSpaceRegionChain,
    nearest_axis,
)

HAND_FIELD = "end_effector"  # of a region, names its hand


def upper_axis(T_world_hand: np.ndarray) -> Axis:
    """Return the axis of the end effector at a pose (4, 4) that points up most."""
    return nearest_axis(T_world_hand[2, :3])


class NamedRegions(Modules):
    """Function of each name: `{"upright": {...}}`, or its first parameter, `{"upright": 0.1}`.

    The file of a name has the function of this name, and an example of its fields.
    """

    def __getitem__(self, name: str) -> Any:
        return getattr(super().__getitem__(name), name.replace("-", "_"))

    def example(self, name: str) -> Any:
        """Return an example of the fields of a name."""
        return super().__getitem__(name).EXAMPLE


NAMED_REGIONS = NamedRegions("constraints/by_name")


def region(name: str, **fields: Any) -> Any:
    """Return a region by name and fields of a problem file: ``region("plane", normal=..., ...)``.

    Names and fields: see `NAMED_REGIONS`; UnknownChoiceError or InvalidInputError for others.
    """
    require_choice("region", name, NAMED_REGIONS)
    return RegionForm(with_functions=True).read({name: fields}, "")


@dataclass(frozen=True)
class RegionForm:
    """Json form of a region: in full (a chain if it has a "base"), or by name."""

    with_functions: bool = False  # whether names of constraints that are no regions are read, too

    @property
    def variant(self) -> str:
        """Ending of the name of its JSON schema."""
        return "" if self.with_functions else "_of_poses"

    def read(self, value: Any, where: str) -> Any:
        """Return the region of a json value."""
        if isinstance(value, TaskSpaceRegion):
            return value
        if isinstance(value, str):
            require_choice(where, value, NAMED_REGIONS)
            filled = json.dumps({value: NAMED_REGIONS.example(value)})
            raise InvalidInputError(f"{where} is {shown(value)}, a name alone; write {filled}")
        full = field_kinds(TaskSpaceRegionChain)
        keys = [key for key in mapping(value, where, ", ".join(full)) if key != "_comment"]
        unknown = next((key for key in keys if key not in (*full, *NAMED_REGIONS)), None)
        if unknown is not None:
            raise InvalidInputError(
                f"{at(where, shown(unknown)[1:-1])} is unknown"
                f"{nearest(unknown, [*full, *NAMED_REGIONS])}; fields: {', '.join(full)}, or one "
                f"of {', '.join(NAMED_REGIONS)} alone, or with {HAND_FIELD}"
            )
        # a region in full may have a field that is called like a name
        names = [key for key in keys if key in NAMED_REGIONS]
        names = [key for key in names if key not in full or "T0_w" not in value]
        if not names:
            kind: Any = TaskSpaceRegionChain if "base" in value else TaskSpaceRegion
            return from_plain(kind, value, where)
        name = names[0]
        if [key for key in keys if key not in (name, HAND_FIELD)]:
            raise InvalidInputError(
                f"{where} has {', '.join(keys)}; a region by name stands alone, or with "
                f"{HAND_FIELD}{_listed(names)}"
            )
        kind, content = NAMED_REGIONS[name], value[name]
        if not isinstance(content, Mapping):
            content = {next(iter(field_kinds(kind))): content}
        made = from_plain(kind, content, at(where, name))
        if not isinstance(made, TaskSpaceRegion) and not self.with_functions:
            raise InvalidInputError(f"{where} is {name}, which is no region: give it as constraint")
        if HAND_FIELD not in value:
            return made
        if not isinstance(made, TaskSpaceRegion):
            raise InvalidInputError(f"{where}: {name} is about no frame: leave out {HAND_FIELD}")
        hand = from_plain(Name | None, value[HAND_FIELD], at(where, HAND_FIELD))
        return made.changed(end_effector=hand)

    def schema(self, schema_of: Any) -> dict[str, Any]:
        """Return the JSON schema of all regions: in full, and by each name."""
        found = [schema_of(TaskSpaceRegion), schema_of(TaskSpaceRegionChain)]
        for name, kind in NAMED_REGIONS.items():
            if not self.with_functions and not issubclass(
                typing.get_type_hints(kind)["return"], TaskSpaceRegion
            ):
                continue
            content = schema_of(kind)
            first, *others = field_kinds(kind).items()
            if first[1] is not Any and field_defaults(kind).keys() >= dict(others).keys():
                alone = {"not": {"type": "object"}, **schema_of(first[1])}
                content = {"anyOf": [alone, content]}
            fields = {name: content, HAND_FIELD: schema_of(Name | None), "_comment": {}}
            found.append(
                {
                    "type": "object",
                    "properties": fields,
                    "required": [name],
                    "additionalProperties": False,
                }
            )
        return {"anyOf": found}


def _listed(names: list[str]) -> str:
    """Return how several regions by name are written, or "" for one."""
    items = ", ".join(f'{{"{name}": ...}}' for name in names)
    return f"; several constraints are a list: [{items}]" if len(names) > 1 else ""


Region = Annotated[TaskSpaceRegion, RegionForm()]


def rpy_of(R: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw (3,) [rad] of a rotation (3, 3); yaw is 0 at a pitch of 90 deg."""
    from scipy.spatial.transform import Rotation  # takes 0.3 s

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # at that pitch, roll and yaw are not unique
        return Rotation.from_matrix(R).as_euler("xyz")
