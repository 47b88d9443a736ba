"""The weights that come with the package, in folders of ``cvqmpt_lab/weights``."""

import hashlib
from pathlib import Path

import cvqmpt_lab
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.models.checkpoint import Checkpoint, load_checkpoint
from cvqmpt_lab.models.mpnet.network import MPNetCheckpoint, load_mpnet
from cvqmpt_lab.models.weights_folder import CONFIG_FILE
from cvqmpt_lab.prediction.configurations import robot_signature
from cvqmpt_lab.robot.robot import Robot

WEIGHTS = Path(cvqmpt_lab.__file__).parent / "weights"
SHIPPED = {"vq_mpt": "the sampler, dictionary and sequence model", "mpnet": "MPNet, to compare with"}
"""Folders and what is in them."""


def shipped_model_folder(name: str = "vq_mpt", weights: Path = WEIGHTS) -> Path:
    """Folder of shipped weights.

    Raises
    ------
    UnknownChoiceError
        For a name that is not in `SHIPPED`.
    InvalidInputError
        When this installation has none.
    """
    if name not in SHIPPED:
        raise UnknownChoiceError("shipped model", name, SHIPPED)
    folder = weights / name
    if not (folder / CONFIG_FILE).is_file():
        raise InvalidInputError(
            f"this installation has no weights of {name!r} in {folder}; name the folder of a model that you "
            "trained (cvqmpt train) or imported (cvqmpt model import)"
        )
    return folder


def load_shipped(robot: Robot, weights: Path = WEIGHTS) -> Checkpoint:
    """The shipped VQ-MPT model, which must belong to the robot; raises `InvalidInputError` like its loader."""
    return load_checkpoint(shipped_model_folder("vq_mpt", weights), robot_signature(robot))


def load_shipped_mpnet(robot: Robot, weights: Path = WEIGHTS) -> MPNetCheckpoint:
    """The shipped MPNet, likewise."""
    return load_mpnet(shipped_model_folder("mpnet", weights), robot_signature(robot))


def shipped_hash(weights: Path = WEIGHTS) -> str:
    """One sha256 of all shipped weights, for the provenance of rows made with them."""
    digest = hashlib.sha256()
    for name in sorted(SHIPPED):
        for path in sorted(shipped_model_folder(name, weights).glob("*.safetensors")):
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()
