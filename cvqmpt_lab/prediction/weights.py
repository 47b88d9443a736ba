"""Where weights are: the one place that finds them by name or folder, for one robot."""

from functools import lru_cache
from pathlib import Path

import cvqmpt_lab
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.robot_signature import OtherRobotError, RobotSignature
from cvqmpt_lab.models.stored import MPNET, VQ_MPT
from cvqmpt_lab.models.weights_folder import checkpoint_folder, read_description

WEIGHTS = Path(cvqmpt_lab.__file__).parent / "weights"
SHIPPED = {"vq_mpt": VQ_MPT, "mpnet": MPNET, "vq_mpt_constrained": VQ_MPT}
"""Names of the weights that come with the package, and their architectures; the first of each is the default."""


def resolve_model(
    model: str | Path | None = None, architecture: str | None = None, robot: RobotSignature | None = None
) -> Path:
    """Folder of a model's weights.

    Parameters
    ----------
    model
        A name of `SHIPPED`, a folder of weights, or that of a training, whose ``model`` is meant; None for
        the shipped ones.
    architecture
        What it must be; None for any.
    robot
        Whom it must belong to; None for any.

    Raises
    ------
    InvalidInputError
        When there is no such model, or one of another architecture.
    OtherRobotError
        When its weights belong to another robot.
    """
    names = [name for name, of in SHIPPED.items() if architecture in (None, of)]
    name = names[0] if model is None else str(model)
    folder = checkpoint_folder(WEIGHTS / name if name in SHIPPED else Path(name))
    if folder is None:
        raise InvalidInputError(
            f"no weights in {model or WEIGHTS / name}; give one of {', '.join(names)}, or the folder of a model "
            "that you trained (cvqmpt train) or imported (cvqmpt model import)"
        )
    read_description(folder, architecture, robot)
    return folder


@lru_cache(maxsize=8)
def _signature(model: str, kind: str) -> RobotSignature:
    return read_description(resolve_model(model, SHIPPED[kind]), SHIPPED[kind]).robot


def incompatibility(model: str, kind: str, robot: RobotSignature) -> str:
    """Why the weights of a model (see `resolve_model`) cannot serve a robot, or ""; kind: a name of `SHIPPED`."""
    try:
        _signature(model, kind).require_same(robot)
    except OtherRobotError as error:
        return str(error)
    return ""
