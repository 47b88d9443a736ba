"""Sizes and options of VQ-MPT and MPNet, stored in ``config.json`` with the weights.

Defaults are from the published models. Values are checked when a configuration is made.
"""

from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.values import Array, Condition, FloatArray, Length

# beginning of a result's `detail` if MPNet found the path; ROLLOUTS_ALONE: without tree growth
BY_ROLLOUTS = "solved by rollouts"
ROLLOUTS_ALONE = f"{BY_ROLLOUTS} alone"
# added to variances in layer norms of the published architecture and of the dictionary
LAYER_NORM_EPSILON = 1e-6

Size = Annotated[int, Condition(int, {"minimum": 1, "maximum": 1 << 16}, f"1 to {1 << 16}")]
Depth = Annotated[int, Condition(int, {"minimum": 1, "maximum": 64}, "1 to 64")]
Dropout = Annotated[
    float, Condition(float, {"minimum": 0.0, "exclusiveMaximum": 1.0}, "0 or more, and less than 1")
]
Share = Annotated[float, Condition(float, {"minimum": 0.0, "maximum": 1.0}, "0 to 1")]
Positive = Annotated[float, Condition(float, {"exclusiveMinimum": 0.0}, "more than 0")]
NotNegative = Annotated[float, Condition(float, {"minimum": 0.0}, "0 or more")]


@dataclass(frozen=True, kw_only=True)
class TransformerConfig:
    """Sizes of a stack of attention layers."""

    n_layers: Depth = 3
    n_heads: Size = 3
    d_k: Size = 512  # width of queries and keys of each head
    d_v: Size = 256  # width of values of each head
    d_model: Size = 512
    d_inner: Size = 1024  # width between the two layers of a feed-forward block
    dropout: Dropout = 0.1


@dataclass(frozen=True, kw_only=True)
class DictionaryConfig:
    """Stage 1, which maps a waypoint to a code z and the code to a Gaussian g(z)."""

    encoder: Literal["transformer", "mlp"] = "transformer"
    """``transformer`` over the whole trajectory (published), or ``mlp`` on each waypoint.

    ``mlp`` uses only `d_model` and `d_inner` of `transformer`.
    """
    transformer: TransformerConfig = field(default_factory=TransformerConfig)
    n_position: Size = 1000  # longest trajectory that the position table covers [waypoints]
    n_codes: Size = 2048
    code_dim: Size = 8
    decoder_dropout: Dropout = 0.5
    commitment: float = 0.25  # beta of the quantization loss
    data_initialised: bool = False
    """Initialise and restart codes from data (`Quantizer.restart_codes`); else only by gradient."""


@dataclass(frozen=True, kw_only=True)
class SetAbstractionConfig:
    """One PointNet++ level: centres, balls around them, and the perceptron over each ball."""

    # share of the points that become centres
    ratio: Annotated[
        float, Condition(float, {"exclusiveMinimum": 0.0, "maximum": 1.0}, "more than 0, at most 1")
    ] = 0.75
    radius: Length  # radius of the ball around a centre [m]
    max_neighbours: Size = 64  # maximum number of points used of each ball
    widths: tuple[Size, Size]  # outputs of the perceptron's two layers


@dataclass(frozen=True, kw_only=True)
class PointCloudConfig:
    """Two levels of set abstraction; the centres of the second level are the scene tokens."""

    sa1: SetAbstractionConfig = SetAbstractionConfig(radius=0.2, widths=(64, 128))
    sa2: SetAbstractionConfig = SetAbstractionConfig(radius=0.4, widths=(256, 512))


@dataclass(frozen=True, kw_only=True)
class SequenceConfig:
    """Stage 2, which maps scene, start and goal to a sequence of codes."""

    # network that encodes start and goal
    context: TransformerConfig = field(default_factory=TransformerConfig)
    transformer: TransformerConfig = field(default_factory=TransformerConfig)  # autoregressive
    max_length: Size = 50  # maximum number of predicted tokens, the goal token included


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """A VQ-MPT model: the published architecture, or a smaller dictionary alone ("compact")."""

    kind: Literal["published", "compact"] = "published"
    joint_dim: Size = 7
    # number of inputs in addition to the joints, such as link positions [m] (compact only)
    feature_dim: int = 0
    dictionary: DictionaryConfig = field(default_factory=DictionaryConfig)
    # encoder and sequence model of the published architecture; both None if it has none
    point_cloud: PointCloudConfig | None = field(default_factory=PointCloudConfig)
    sequence: SequenceConfig | None = field(default_factory=SequenceConfig)
    # sizes of the scene transformer, if the model has one
    transformer: "SceneTransformerConfig | None" = None

    def __post_init__(self) -> None:
        if (self.point_cloud is None) != (self.sequence is None):
            raise InvalidInputError("give both point_cloud and sequence, or set both to null")
        dictionary = self.dictionary
        if self.kind == "published":
            width = self.stage2[1].transformer.d_model
            departures = {
                "feature_dim": self.feature_dim > 0,
                "dictionary.encoder": dictionary.encoder != "transformer",
                "dictionary.data_initialised": dictionary.data_initialised,
            }
            for name, departs in departures.items():
                if departs:
                    raise InvalidInputError(f"kind 'published' has no {name}; use kind 'compact'")
            if dictionary.transformer.d_model != width:
                raise InvalidInputError(
                    f"kind 'published' has one latent width: {width} is not "
                    f"{dictionary.transformer.d_model}"
                )
        if self.point_cloud is not None and self.sequence is not None:
            width = self.sequence.transformer.d_model
            others = (self.point_cloud.sa2.widths[1], self.sequence.context.d_model)
            if others != (width, width):
                raise InvalidInputError(
                    f"a sequence model has one latent width: {width} is not {others}"
                )

    @property
    def stage2(self) -> tuple[PointCloudConfig, SequenceConfig]:
        """Sizes of the published sequence model; InvalidInputError if the model has none."""
        if self.point_cloud is None or self.sequence is None:
            raise InvalidInputError(
                f"a model of kind {self.kind!r} without point_cloud and sequence has no sequence "
                "model; use kind 'published'"
            )
        return self.point_cloud, self.sequence

    @property
    def configuration_dim(self) -> int:
        """Number of inputs of a configuration: joints and features."""
        return self.joint_dim + self.feature_dim

    @property
    def goal_class(self) -> int:
        """Class of the goal token, which ends a sequence; the class before it: the start token."""
        return self.dictionary.n_codes + 1


@dataclass(frozen=True, kw_only=True)
class MPNetConfig:
    """Sizes of MPNet; defaults are from the published 7-joint model."""

    joint_dim: Size = 7
    n_points: Size = 4120  # points of a cloud, drawn at random from a larger cloud
    encoder_widths: tuple[Size, ...] = (786, 512, 256)  # hidden layers of the cloud encoder
    code_dim: Size = 60  # width of an encoded cloud
    # hidden layers of the planning network
    planner_widths: tuple[Size, ...] = (1280, 896, 512, 384, 256, 128, 64, 32)
    dropout: Dropout = 0.5  # after each hidden layer of the planning network except the last

    def __post_init__(self) -> None:
        if not self.encoder_widths or not self.planner_widths:
            raise InvalidInputError("encoder_widths and planner_widths need a layer each")


@dataclass(frozen=True, eq=False)
class SerialChain:
    """A serial chain of joints, T_j = T_(j-1) (R_j, t_j) Rz(q_j), and points on its links.

    T_0 is the robot's base. A prismatic joint has Tz(q_j) instead of Rz(q_j).
    """

    rotation: Annotated[FloatArray, Array((None, 3, 3))]  # (n, 3, 3), R_j
    translation: Annotated[FloatArray, Array((None, 3), "[m]")]  # (n, 3) [m], t_j
    points: tuple[int, ...]  # (k,), index of the joint frame that each point is fixed to
    offsets: Annotated[FloatArray, Array((None, 3), "[m]")]  # (k, 3) [m], position in that frame
    sliders: tuple[int, ...] = ()  # indices of the prismatic joints

    def __post_init__(self) -> None:
        joints = len(self.rotation)
        if (
            len(self.translation) != joints
            or not self.points
            or len(self.points) != len(self.offsets)
        ):
            raise InvalidInputError(
                f"rotation, translation, points and offsets describe {joints}, "
                f"{len(self.translation)}, {len(self.points)} and {len(self.offsets)}; give equal "
                "numbers of each pair, and at least one point"
            )
        for name, listed in (("points", self.points), ("sliders", self.sliders)):
            if max(listed, default=0) >= joints:
                raise InvalidInputError(f"{name} are frames 0 to {joints - 1}, not {list(listed)}")

    @property
    def feature_dim(self) -> int:
        """Number of coordinates of all points, 3 k."""
        return 3 * len(self.points)

    @property
    def turns_about_base(self) -> bool:
        """Whether joint 1 rotates the whole robot: its axis is the z axis of the base."""
        if 0 in self.sliders:
            return False
        on_axis = np.abs(self.translation[0, :2]).max() < 1e-6
        return bool(on_axis and np.allclose(self.rotation[0, :, 2], (0.0, 0.0, 1.0), atol=1e-6))


@dataclass(frozen=True, kw_only=True)
class SceneTransformerSizes:
    """Sizes of `SceneTransformer`; defaults are from the shipped weights."""

    width: Size = 128
    layers: Depth = 3  # number of layers of the causal transformer
    heads: Size = 4
    groups: Size = 128  # groups of points, one scene token each
    group_size: Size = 32  # points of each group
    values: Size = 8  # m, numbers that a body point reads from the tokens
    edge_width: Size = 64
    links: Size = 20  # number of nearest codes that a start or goal is linked to
    stride: Size = 4  # codes 0, stride, 2 stride, ... are landmarks that sequences attend to

    def __post_init__(self) -> None:
        if self.width % 8 or self.width % self.heads:
            raise InvalidInputError(
                f"width {self.width} must be divisible by 8 and by heads, {self.heads}"
            )


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneTransformerConfig:
    """Sizes of a scene transformer, with the kinematics and roadmap that it is made for."""

    # the same for all weights
    position_waves: ClassVar[int] = 5  # frequencies of the encoding of a position
    collision_cost: ClassVar[float] = 3.0  # w [rad]: a motion costs length - w log P(free)
    unreached_cost: ClassVar[float] = 30.0  # [rad] cost to go if no path leads to the goal
    max_advantage: ClassVar[float] = 10.0  # [rad] upper bound of the advantages A_i
    max_codes: ClassVar[int] = 13  # codes of a sequence
    empty_cloud_point: ClassVar = (0.0, 0.0, -0.87)  # [m] position of all points of an empty cloud

    lower: tuple[float, ...]  # (n,) joint limits [rad or m]
    upper: tuple[float, ...]  # (n,) joint limits [rad or m]
    body: SerialChain  # kinematics, and the body points that attend to the scene
    n_nodes: Size  # nodes of the roadmap: one for each code of the dictionary
    n_edges: Size
    sizes: SceneTransformerSizes = field(default_factory=SceneTransformerSizes)

    def __post_init__(self) -> None:
        if self.sizes.links > self.n_nodes:
            raise InvalidInputError(
                f"links is {self.sizes.links}; give at most n_nodes, {self.n_nodes}"
            )

    @property
    def joint_dim(self) -> int:
        """Number of joints n."""
        return len(self.lower)

    @property
    def features(self) -> int:
        """Number of inputs of a configuration: scaled joints, sines, cosines and body points."""
        return 3 * self.joint_dim + self.body.feature_dim
