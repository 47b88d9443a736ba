"""Objects that the hand carries."""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.scene.shapes import Shape, shape_from_dict, shape_to_dict


@dataclass(frozen=True, eq=False)
class Attachment:
    """A shape fixed to the robot's end effector.

    Attributes
    ----------
    T_hand_object: (4, 4), pose of the shape in the end-effector frame [m].
    """

    name: str
    shape: Shape
    T_hand_object: np.ndarray

    def __post_init__(self) -> None:
        T = np.array(self.T_hand_object, dtype=float)
        rigid = T.shape == (4, 4) and np.isfinite(T).all()
        if not (rigid and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)):
            raise InvalidInputError(
                f"attachment {self.name!r}: T_hand_object is not a finite rigid pose (4, 4)"
            )
        if not isinstance(self.name, str):
            raise InvalidInputError(f"attachment field 'name' must be a string, not {self.name!r}")
        T.setflags(write=False)
        object.__setattr__(self, "T_hand_object", T)

    def to_dict(self) -> dict:
        """Plain json form."""
        return {
            "name": self.name,
            "shape": shape_to_dict(self.shape),
            "T_hand_object": np.asarray(self.T_hand_object).tolist(),
        }

    @staticmethod
    def from_dict(data: dict) -> "Attachment":
        """Inverse of to_dict; names the missing or malformed field."""
        try:
            T = np.array(data["T_hand_object"], dtype=float).reshape(4, 4)
            return Attachment(data["name"], shape_from_dict(data["shape"]), T)
        except KeyError as error:
            raise InvalidInputError(f"attachment field {error} is missing") from error
        except (TypeError, ValueError) as error:
            raise InvalidInputError(f"attachment is malformed: {error}") from error
