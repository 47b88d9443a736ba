"""Sizes and options of a model, as frozen data that goes to json and back.

Defaults are the paper's; `ModelConfig.compact` is the smaller model with every departure switched on,
each of which is one named field that can be switched off again.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Self

from cvqmpt_lab.codec import from_plain, to_plain
from cvqmpt_lab.errors import InvalidInputError


@dataclass(frozen=True, kw_only=True)
class TransformerConfig:
    """Sizes of a stack of attention layers; `d_k` and `d_v` are per head."""

    n_layers: int = 3
    n_heads: int = 3
    d_k: int = 512
    d_v: int = 256
    d_model: int = 512
    d_inner: int = 1024
    dropout: float = 0.1


@dataclass(frozen=True, kw_only=True)
class DictionaryConfig:
    """Stage 1: waypoint -> code -> Gaussian.

    Attributes
    ----------
    encoder: ``transformer`` over the whole trajectory (published) or ``mlp`` on each waypoint alone,
        which uses only `d_model` and `d_inner` of `transformer`.
    n_position: longest trajectory the transformer's position table covers [waypoints].
    n_codes, code_dim: size of the dictionary.
    commitment: beta of the quantization loss.
    data_initialised: codes start at encoded waypoints and unused ones are restarted from data
        (`quantizer.Quantizer.restart_codes`); without it they are learnt by gradient alone.
    """

    encoder: Literal["transformer", "mlp"] = "transformer"
    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    n_position: int = 1000
    n_codes: int = 2048
    code_dim: int = 8
    decoder_dropout: float = 0.5
    commitment: float = 0.25
    data_initialised: bool = False


@dataclass(frozen=True, kw_only=True)
class SetAbstractionConfig:
    """One PointNet++ level: centres, their neighbourhoods and the perceptron over each.

    Attributes
    ----------
    ratio, count: keep this share of the points, or this many (fewer when there are fewer); one is None.
    radius: of the ball around a centre [m].
    max_neighbours: points used of each ball.
    widths: outputs of the perceptron's two layers.
    """

    ratio: float | None = None
    count: int | None = None
    radius: float
    max_neighbours: int = 64
    widths: tuple[int, int]

    def __post_init__(self) -> None:
        if (self.ratio is None) == (self.count is None):
            raise InvalidInputError(f"set abstraction: give ratio or count, not {self.ratio}, {self.count}")


@dataclass(frozen=True, kw_only=True)
class PointCloudConfig:
    """Two levels of set abstraction; the second one's centres are the scene tokens.

    max_points: larger clouds are thinned to every so-many-th point (compact only); None for all.
    """

    max_points: int | None = None

    sa1: SetAbstractionConfig = SetAbstractionConfig(ratio=0.75, radius=0.2, widths=(64, 128))
    sa2: SetAbstractionConfig = SetAbstractionConfig(ratio=0.75, radius=0.4, widths=(256, 512))


@dataclass(frozen=True, kw_only=True)
class SequenceConfig:
    """Stage 2: scene, start and goal -> sequence of codes.

    Attributes
    ----------
    context: cross attention of start and goal to the scene; None in the compact model, whose layers
        attend to the scene themselves.
    transformer: the model of the sequence.
    max_length: tokens predicted at most, the goal token included.
    start_goal_codes: start and goal enter also by their codes in the dictionary (compact only).
    refinement: a Gaussian of its own for every predicted step (compact only).
    collision_head, connectivity_head: P(configuration free), P(straight motion free) (compact only).
    head_level: scene tokens those two heads attend to: the few of the second level or the many of the
        first.
    """

    context: TransformerConfig | None = field(default_factory=TransformerConfig)
    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    max_length: int = 50
    start_goal_codes: bool = False
    refinement: bool = False
    collision_head: bool = False
    connectivity_head: bool = False
    head_level: Literal["coarse", "fine"] = "fine"


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """Everything needed to build a VQ-MPT model.

    Attributes
    ----------
    kind: ``published``, the architecture of the published checkpoints, or ``compact``.
    joint_dim: joints of the robot.
    feature_dim: numbers that describe a configuration beside its joints, such as link positions by
        forward kinematics, flattened [m]; 0 for none (compact only).
    """

    kind: Literal["published", "compact"] = "published"
    joint_dim: int = 7
    feature_dim: int = 0
    dictionary: DictionaryConfig = field(default_factory=DictionaryConfig)
    point_cloud: PointCloudConfig = field(default_factory=PointCloudConfig)
    sequence: SequenceConfig = field(default_factory=SequenceConfig)

    def __post_init__(self) -> None:
        sizes = (self.joint_dim, self.dictionary.n_codes, self.dictionary.code_dim)
        if min(sizes) < 1:
            raise InvalidInputError(f"joint_dim, n_codes and code_dim must be at least 1, not {sizes}")
        sequence, width = self.sequence, self.sequence.transformer.d_model
        departures = {
            "feature_dim": self.feature_dim > 0,
            "dictionary.encoder": self.dictionary.encoder != "transformer",
            "dictionary.data_initialised": self.dictionary.data_initialised,
            "start_goal_codes": sequence.start_goal_codes,
            "refinement": sequence.refinement,
            "collision_head": sequence.collision_head,
            "connectivity_head": sequence.connectivity_head,
            "point_cloud.max_points": self.point_cloud.max_points is not None,
            "null sequence.context": sequence.context is None,
        }
        if self.kind == "published":
            named = [name for name, departs in departures.items() if departs]
            if named:
                raise InvalidInputError(f"kind 'published' has no {named[0]}; use kind 'compact'")
            widths = (self.dictionary.transformer.d_model, self.point_cloud.sa2.widths[1])
            if sequence.context is None or {*widths, sequence.context.d_model} != {width}:
                raise InvalidInputError(f"kind 'published' has one latent width: {width} is not {widths}")
        elif sequence.context is not None:
            raise InvalidInputError("kind 'compact' has no sequence.context; set it to null")
        elif sequence.transformer.d_k != sequence.transformer.d_v:
            raise InvalidInputError(
                f"kind 'compact' has d_v equal to d_k in sequence.transformer, not {sequence.transformer.d_v} "
                f"and {sequence.transformer.d_k}"
            )

    @property
    def configuration_dim(self) -> int:
        """Numbers a configuration is given by: joints and features."""
        return self.joint_dim + self.feature_dim

    @property
    def goal_class(self) -> int:
        """Class of the token that ends a sequence; the one before it is the start token's."""
        return self.dictionary.n_codes + 1

    @classmethod
    def published(cls, joint_dim: int = 7) -> Self:
        """Architecture and sizes of the paper."""
        return cls(kind="published", joint_dim=joint_dim)

    @classmethod
    def compact(cls, joint_dim: int = 7, feature_dim: int = 0, n_codes: int = 1024) -> Self:
        """About a tenth of the size, made for one CPU core, every departure from the paper on."""
        small = TransformerConfig(n_heads=4, d_k=32, d_v=32, d_model=128, d_inner=256, dropout=0.1)
        return cls(
            kind="compact",
            joint_dim=joint_dim,
            feature_dim=feature_dim,
            dictionary=DictionaryConfig(
                encoder="mlp",
                transformer=small,
                n_codes=n_codes,
                decoder_dropout=0.0,
                data_initialised=True,
            ),
            point_cloud=PointCloudConfig(
                max_points=2048,
                sa1=SetAbstractionConfig(count=256, radius=0.15, max_neighbours=16, widths=(32, 64)),
                sa2=SetAbstractionConfig(count=64, radius=0.4, max_neighbours=32, widths=(128, 128)),
            ),
            sequence=SequenceConfig(
                context=None,
                transformer=small,
                start_goal_codes=True,
                refinement=True,
                collision_head=feature_dim > 0,
                connectivity_head=feature_dim > 0,
            ),
        )

    def to_json(self) -> dict[str, Any]:
        """Plain dictionaries, lists, numbers and strings."""
        return to_plain(self, complete=True)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Build what `to_json` wrote.

        Raises
        ------
        InvalidInputError
            Naming the field that is unknown, missing or of the wrong type.
        """
        return from_plain(cls, data, "model", complete=True)
