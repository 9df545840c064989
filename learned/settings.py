"""What a network is made of, how it is judged and how it is trained: frozen settings that go into every checkpoint.

Plain dataclasses, so that training needs nothing but PyTorch and NumPy. Values are checked on construction; unknown
keys are errors. What the paper leaves open is named in the attribute's description.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from hybridlio.cloud.projection import MAP_GEOMETRIES, MapGeometry
from hybridlio.core.errors import ConfigError
from hybridlio.core.setting_checks import check_positive

_S = TypeVar("_S")


@dataclass(frozen=True)
class NetworkSettings:
    """The network.

    Attributes:
        imu: what the IMU is used for: ``initial-pose`` (the method), ``feature`` (its features join those of the scans,
            the initial pose is the identity), ``none``, or ``given`` (the initial pose comes from elsewhere).
        normals: ``separate`` (translation from vertex features alone), ``joined`` (both from all features), ``none``.
        head: ``attention`` (the paper's gate) or ``mlp`` (``tanh(W₂ tanh(W₁x + b₁) + b₂)``).
        siamese: ``shared``: the two encoders, and the two LSTMs, have the same weights, but for normalisation layers,
            which each encoder has of its own; or ``twins`` of one structure, each with weights of its own. Shared
            branches both take the inputs that ``velocity`` and ``distance`` add.
        rotation: ``euler`` angles (roll, pitch, yaw) or ``log``, a rotation vector.
        geometry: cells of the maps.
        imu_samples: S, rows of inertial data between two scans.
        imu_hidden, imu_layers: size of the LSTMs; not in the paper.
        velocity: the translation LSTM also sees the last velocity and starts from what it gives at constant speed;
            not in the paper.
        mean_rate: the orientation LSTM starts from the rotation that the mean angular velocity gives; not in the paper.
        encoder: whether the residual network is there; without it, ``projective_steps`` give the residual.
        stem, stages: channels of the encoder's first convolution and of its stages, as ResNet-18; not in the paper.
        stem_stride: rows and columns that the first convolution moves by; not in the paper.
        blocks: residual blocks a stage; not in the paper.
        normalisation: ``batch`` (ResNet's), ``group``, which does not depend on the batch, or ``none``.
        features: outputs of the fully connected layer after pooling; not in the paper.
        pooled_columns: sectors of azimuth that are pooled by themselves; 1 pools everything.
        iterations: how often the residual is estimated, each from the maps moved by all before; the paper's is 1.
        remap_gradient: whether gradients reach the initial pose also through the maps that it moves, as in the paper;
            without, only through ``T = δT·T̂``, which takes half the time.
        distance: more inputs, from the plane of the last scan in each cell: the signed ``distance`` d of the moved
            point to it, or with it the ``gradient`` of d²/2 by translation and rotation, d·n and d·(p × n). Not in the
            paper.
        projective_steps: each iteration starts with so many weighted steps of point-to-plane registration between the
            maps (:mod:`hybridlio.learned.networks.projective_steps`), which the residual network corrects; not in the
            paper.
        weight_channels: of the network that gives their weights; 0 takes the robust kernel's weights alone.
        vertex_scale_m: vertices are divided by it.
        residual_scale: the last layers' weights start smaller by it, so that training starts near δT = 1.
        output_scale: what the last layers give is multiplied by it, since Adam's steps are as large however small a
            layer's outputs should be; not in the paper.
    """

    imu: Literal["initial-pose", "feature", "none", "given"] = "initial-pose"
    normals: Literal["separate", "joined", "none"] = "separate"
    head: Literal["attention", "mlp"] = "attention"
    siamese: Literal["shared", "twins"] = "shared"
    rotation: Literal["euler", "log"] = "euler"
    geometry: MapGeometry = MAP_GEOMETRIES["hdl-64e"]
    imu_samples: int = 15
    imu_hidden: int = 128
    imu_layers: int = 2
    velocity: bool = False
    mean_rate: bool = False
    encoder: bool = True
    stem: int = 32
    stem_stride: tuple[int, int] = (1, 2)
    stages: tuple[int, ...] = (32, 64, 128, 256)
    blocks: int = 2
    normalisation: Literal["batch", "group", "none"] = "batch"
    features: int = 256
    pooled_columns: int = 1
    iterations: int = 1
    remap_gradient: bool = True
    distance: Literal["none", "distance", "gradient"] = "none"
    projective_steps: int = 0
    weight_channels: int = 8
    vertex_scale_m: float = 20.0
    residual_scale: float = 0.1
    output_scale: float = 1.0

    def __post_init__(self) -> None:
        _check_choices(self)
        positive = ("imu_samples", "imu_hidden", "imu_layers", "stem", "blocks", "features", "pooled_columns")
        check_positive(self, *positive, "iterations", "vertex_scale_m", "residual_scale", "output_scale")
        if (
            min(self.projective_steps, self.weight_channels) < 0
            or len(self.stem_stride) != 2
            or min(self.stem_stride) < 1
        ):
            raise ConfigError(
                "network: projective_steps and weight_channels must not be negative, stem_stride two of 1 up"
            )
        if not self.encoder and not self.projective_steps:
            raise ConfigError("network: without encoder it needs projective_steps, else nothing gives a residual")
        if not self.stages or min(self.stages) < 1:
            raise ConfigError(f"network: stages needs channels of 1 or more each, got {self.stages}")


@dataclass(frozen=True)
class LossSettings:
    """The unsupervised loss.

    Attributes:
        alpha, lambda_: weights of the point-to-plane and the plane-to-plane term.
        product: ``dot`` for ``|n·d|``, or ``element-wise`` for ``Σᵢ|nᵢdᵢ|``, as the paper's text has it.
        matching: ``nearest`` in the whole last cloud, ``nearest-projected`` among the points that the maps show, or
            ``same-pixel``.
        kernel: ``l1`` (the paper's), ``huber`` or ``geman-mcclure`` on the point-to-plane distance.
        kernel_m: where the kernel bends.
        max_distance_m: points farther from their match count for nothing; the paper has no limit.
        reduction: ``sum`` over the points (the paper's) or their ``mean``.
        matched_at: matches are looked for at ``each`` pose that is judged, or once at the ``answer``, the last of them.
        initial_weight: of the loss at the initial pose itself beside that of the answers, which hardly depend on it
            once the residual undoes its error; the paper's is 0.
        target_weight: of the distance, in metres with rotations at 10 m, to where ``target_steps`` Gauss-Newton steps
            down the loss lead from the answer. The loss itself hardly weighs directions that few points see, such as
            ahead on an open road; this weighs all alike. Not in the paper.
        keep_ground: the clouds keep the ground, which the paper removes; decided when recordings are prepared.
        normal_thin_m: side of the voxels to whose mean points planes are fitted for the clouds' normals; 0 fits them
            to the full cloud, as the paper does; decided when recordings are prepared.
    """

    alpha: float = 1.0
    lambda_: float = 0.1
    product: Literal["dot", "element-wise"] = "dot"
    matching: Literal["nearest", "nearest-projected", "same-pixel"] = "nearest"
    kernel: Literal["l1", "huber", "geman-mcclure"] = "l1"
    kernel_m: float = 0.1
    max_distance_m: float = float("inf")
    reduction: Literal["sum", "mean"] = "sum"
    matched_at: Literal["each", "answer"] = "each"
    initial_weight: float = 0.0
    target_weight: float = 0.0
    target_steps: int = 2
    keep_ground: bool = False
    normal_thin_m: float = 0.2

    def __post_init__(self) -> None:
        _check_choices(self)
        check_positive(self, "kernel_m", "max_distance_m")
        weights = (self.alpha, self.lambda_, self.initial_weight, self.target_weight)
        if min(*weights, self.target_steps, self.normal_thin_m) < 0 or self.alpha + self.lambda_ == 0:
            raise ConfigError(
                "loss: alpha, lambda_, initial_weight, target_weight, target_steps, normal_thin_m must be 0 or more, "
                f"and alpha and lambda_ not both 0; got {weights}, {self.target_steps} and {self.normal_thin_m}"
            )


@dataclass(frozen=True)
class OptimiserSettings:
    """How weights are found.

    Attributes:
        epochs: passes over the data; the paper does not say how many.
        batch: pairs a step, over all processes together.
        learning_rate: at the start.
        schedule: ``step`` halves it every ``step_epochs``; ``cosine`` lets it fall to 0 over all epochs.
        step_epochs, step_factor: of the step schedule.
        betas, weight_decay: Adam's.
        clip_norm: gradients longer than this are shortened; 0 leaves them.
        seed: of the weights, the order of the pairs and the noise.
        mixed_precision: encoders compute in bfloat16 on a GPU.
        initial_noise_rad, initial_noise_m: standard deviation by axis of what initial poses are shaken by before the
            residual network sees them.
        velocity_noise_m_s: standard deviation by axis of what the last velocity is shaken by.
        mirrored, swapped: share of pairs that are seen in a mirror that swaps left and right, and that run backwards,
            from the current scan to the last one.
        points: points of the current cloud that the loss takes, drawn anew each time; 0 takes all.
        balanced: share of them that comes in equal numbers from those whose normals lie mainly along x, y and z.
    """

    epochs: int = 100
    batch: int = 20
    learning_rate: float = 1e-4
    schedule: Literal["step", "cosine"] = "step"
    step_epochs: int = 20
    step_factor: float = 0.5
    betas: tuple[float, float] = (0.9, 0.99)
    weight_decay: float = 1e-5
    clip_norm: float = 0.0
    seed: int = 0
    mixed_precision: bool = False
    initial_noise_rad: float = 0.0
    initial_noise_m: float = 0.0
    velocity_noise_m_s: float = 0.0
    mirrored: float = 0.0
    swapped: float = 0.0
    points: int = 0
    balanced: float = 0.0

    def __post_init__(self) -> None:
        _check_choices(self)
        check_positive(self, "epochs", "batch", "learning_rate", "step_epochs", "step_factor")
        if len(self.betas) != 2 or not all(0 <= beta < 1 for beta in self.betas):
            raise ConfigError(f"optimiser: betas are two numbers from 0 to below 1, got {self.betas}")
        noises = (self.initial_noise_rad, self.initial_noise_m, self.velocity_noise_m_s)
        if min(self.weight_decay, self.clip_norm, self.points, *noises) < 0:
            raise ConfigError("optimiser: weight_decay, clip_norm, noise and points must be 0 or more")
        shares = (self.mirrored, self.swapped, self.balanced)
        if not all(0 <= share <= 1 for share in shares):
            raise ConfigError(f"optimiser: mirrored, swapped and balanced are shares from 0 to 1, got {shares}")


@dataclass(frozen=True)
class Recipe:
    """Everything that decides what a training run gives, but the data.

    Attributes:
        name: of the preset it came from.
        network, loss, optimiser: the settings.
    """

    name: str = "custom"
    network: NetworkSettings = field(default_factory=NetworkSettings)
    loss: LossSettings = field(default_factory=LossSettings)
    optimiser: OptimiserSettings = field(default_factory=OptimiserSettings)


def to_dict(settings: Any) -> dict[str, Any]:
    """Settings as plain values, for JSON: an infinite limit becomes ``"inf"``."""
    values = dataclasses.asdict(settings)
    return {key: _plain(value) for key, value in values.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, tuple):
        return list(value)
    return "inf" if value == float("inf") else value


def from_dict(kind: type[_S], values: Mapping[str, Any], where: str = "settings") -> _S:
    """Settings of a kind from plain values.

    Raises:
        ConfigError: a key is unknown or missing, or a value of the wrong type or out of range; says where.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where}: expected named values, got {type(values).__name__}")
    hints = typing.get_type_hints(kind)
    known = [f.name for f in dataclasses.fields(kind)]  # type: ignore[arg-type]
    unknown = [key for key in values if key not in known]
    if unknown:
        raise ConfigError(f"{where}: unknown {', '.join(map(repr, unknown))}; there are {', '.join(known)}")
    required = [f.name for f in dataclasses.fields(kind) if f.default is f.default_factory is dataclasses.MISSING]  # type: ignore[arg-type]
    missing = [name for name in required if name not in values]
    if missing:
        raise ConfigError(f"{where}: {', '.join(map(repr, missing))} missing")
    return kind(**{key: _typed(hints[key], value, f"{where}.{key}") for key, value in values.items()})


def _typed(hint: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return from_dict(typing.cast("type[Any]", hint), value, where)
    if typing.get_origin(hint) is tuple:
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{where}: expected a list, got {value!r}")
        return tuple(_typed(typing.get_args(hint)[0], item, where) for item in value)
    if typing.get_origin(hint) is Literal or isinstance(hint, types.UnionType):
        return value
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint is float and (number or value == "inf"):
        return float(value)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise ConfigError(f"{where}: expected {hint.__name__}, got {value!r}")
    return value


def _check_choices(settings: Any) -> None:
    for name, hint in typing.get_type_hints(type(settings)).items():
        if typing.get_origin(hint) is Literal and getattr(settings, name) not in typing.get_args(hint):
            choices = ", ".join(typing.get_args(hint))
            raise ConfigError(f"{name} is one of {choices}, not {getattr(settings, name)!r}")
