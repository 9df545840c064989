"""Settings of a network, of its loss and of its training: frozen values that every checkpoint and weights file holds.

Plain dataclasses, so that training needs only PyTorch and NumPy. Values are checked on construction, and unknown keys
are errors. Defaults are the paper's where it states one; the descriptions say where it does not.
"""

from __future__ import annotations

import typing
from dataclasses import dataclass, field
from typing import Any, Literal

from hybridlio.cloud.map_geometry import MAP_GEOMETRIES, MapGeometry
from hybridlio.core.errors import ConfigError
from hybridlio.core.setting_checks import (
    SettingError,
    check_fraction,
    check_not_negative,
    check_positive,
    check_setting,
)

# Far above any network of use (the paper's widest part has 512 features): a damaged recipe must not take all memory.
_MOST, _DEEPEST = 10_000, 100  # of widths; of layers one behind the other


@dataclass(frozen=True)
class NetworkSettings:
    """Structure of the network.

    Attributes:
        imu: use of the IMU: ``initial-pose`` (the method); ``feature``, where its features join those of the scans and
            the initial pose is the identity; ``none``; or ``given``, where the initial pose comes from another source.
        normals: ``separate`` (translation from vertex features only), ``joined`` (both from all features), ``none``.
        head: ``attention`` (the paper's gate) or ``mlp`` (``tanh(W₂ tanh(W₁x + b₁) + b₂)``).
        siamese: ``shared``, where the two encoders and the two LSTMs have the same weights, except for one
            normalisation layer an encoder; or ``twins``, of one structure with separate weights. Both of two shared
            branches take the inputs that ``velocity`` and ``distance`` add.
        rotation: ``euler`` angles (roll, pitch, yaw) or ``log``, a rotation vector.
        geometry: cells of the maps.
        imu_samples: S, the number of IMU rows between two scans.
        imu_hidden, imu_layers: size of the LSTMs; not in the paper.
        velocity: the translation LSTM also takes the last velocity, and its output is added to the translation at that
            velocity; not in the paper.
        mean_rate: the output of the orientation LSTM is added to the rotation at the mean angular velocity; not in the
            paper.
        encoder: whether there is a residual network; without one, ``projective_steps`` estimate the residual.
        stem, stages: channels of the encoder's first convolution and of its stages; not in the paper.
        stem_stride: stride of the first convolution along rows and columns; not in the paper.
        blocks: residual blocks in a stage; not in the paper.
        normalisation: ``batch`` (as in ResNet); ``group``, which does not depend on the batch; or ``none``.
        features: outputs of the fully connected layer after pooling; not in the paper.
        pooled_columns: sectors of azimuth that are pooled separately; 1 pools the whole map.
        iterations: number of residual estimates, each from the maps moved by the ones before; 1 in the paper.
        remap_gradient: whether gradients reach the initial pose also through the maps that it moves, as in the paper.
            Without it they reach it only through ``T = δT·T̂``, and training takes half the time.
        distance: inputs added to the vertex maps, from the distance d of each moved point to the plane (normal n) of
            its cell in the last map: ``distance`` adds d; ``gradient`` adds d and the derivatives of d²/2 by
            translation and rotation, d·n and d·(p × n). ``none`` in the paper.
        projective_steps: number of weighted point-to-plane registration steps between the maps before the residual
            network in each iteration (:mod:`hybridlio.learned.networks.projective_steps`); 0 in the paper.
        weight_channels: channels of the network that weights their points; 0 uses the robust kernel's weights only.
        vertex_scale_m: divisor of vertices, so that inputs are of order 1; most points of a scan are within 20 m.
        residual_scale: factor on the initial weights of the last layers, so that training starts near δT = 1.
        output_scale: factor on the outputs of the last layers. Adam moves every weight by about the learning rate,
            whatever the size of the outputs; this sets their size. 1 in the paper.

    Raises:
        ConfigError: a value is out of range, or neither encoder nor steps estimate the residual.
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
        counts = (
            "imu_samples",
            "imu_hidden",
            "imu_layers",
            "stem",
            "blocks",
            "features",
            "pooled_columns",
            "iterations",
        )
        check_positive(self, *counts, "vertex_scale_m", "residual_scale", "output_scale")
        check_not_negative(self, "projective_steps", "weight_channels")
        for name in (*counts, "projective_steps", "weight_channels"):
            most = _DEEPEST if name in ("blocks", "imu_layers", "iterations", "projective_steps") else _MOST
            check_setting(self, name, getattr(self, name) <= most, f"{most} or less")
        stride, stages = self.stem_stride, self.stages
        check_setting(self, "stem_stride", len(stride) == 2 and min(stride) >= 1, "two numbers of 1 or more")
        check_setting(self, "stages", bool(stages) and min(stages) >= 1, "one or more numbers of 1 or more")
        check_setting(self, "stages", len(stages) <= 16 and max(stages) <= _MOST, f"16 numbers of {_MOST} or less")
        if not self.encoder and not self.projective_steps:
            raise ConfigError("network: set encoder, or projective_steps above 0: nothing else estimates the residual")

    @property
    def fits_any_cells(self) -> bool:
        """Whether weights trained on one geometry work on another.

        Steps weigh single cells by their neighbours; an encoder pools all cells into features of one geometry.
        """
        return not self.encoder


@dataclass(frozen=True)
class LossSettings:
    """The unsupervised loss.

    Attributes:
        alpha, lambda_: weights of the point-to-plane and of the plane-to-plane term.
        product: ``dot`` for ``|n·d|``, or ``element-wise`` for ``Σᵢ|nᵢdᵢ|``, as in the paper's text.
        matching: ``nearest`` neighbour in the whole last cloud; ``nearest-projected``, among the points that the maps
            show; or ``same-pixel``.
        kernel: ``l1`` (the paper's), ``huber`` or ``geman-mcclure`` on the point-to-plane distance.
        kernel_m: distance at which ``huber`` and ``geman-mcclure`` turn from quadratic to robust.
        max_distance_m: matches farther apart are left out; the paper has no limit.
        reduction: ``sum`` over the points (the paper's) or their ``mean``.
        matched_at: search matches at ``each`` pose in the loss, or once at the ``answer``, the last of them.
        initial_weight: weight of the loss at the initial pose, which otherwise gets hardly any gradient once the
            residual corrects its errors; 0 in the paper.
        target_weight: weight of the distance, in metres with rotations at a lever of 10 m, between the answer and the
            result of ``target_steps`` Gauss-Newton steps on the loss from there. The loss itself hardly weights
            directions that few points constrain, such as ahead on an open road; this weights all alike. 0 in the paper.
        keep_ground: whether the clouds keep the ground, which the paper removes. Takes effect when recordings are
            prepared.
        normal_thin_m: planes for the normals of the clouds are fitted to the means of voxels of this side; 0 fits them
            to the full cloud, as the paper does. Takes effect when recordings are prepared.

    Raises:
        ConfigError: a value is out of range.
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
        check_not_negative(self, "alpha", "lambda_", "initial_weight", "target_weight", "target_steps", "normal_thin_m")
        check_setting(self, "alpha", self.alpha + self.lambda_ > 0, "above 0 where lambda_ is 0")


@dataclass(frozen=True)
class OptimiserSettings:
    """How a network is trained.

    Attributes:
        epochs: passes over the data; not in the paper.
        batch: pairs per step, over all processes.
        learning_rate: initial learning rate.
        schedule: ``step`` multiplies the rate by ``step_factor`` every ``step_epochs``; ``cosine`` lets it fall to 0
            over all epochs.
        step_epochs, step_factor: of the step schedule.
        betas, weight_decay: of Adam.
        clip_norm: limit on the norm of the gradient; 0 for none.
        seed: of the initial weights, the order of the pairs and the noise.
        mixed_precision: encoders compute in bfloat16 on a GPU.
        initial_noise_rad, initial_noise_m: standard deviation by axis of the perturbation of initial poses before the
            residual network sees them.
        velocity_noise_m_s: standard deviation by axis of the perturbation of the last velocity.
        mirrored, swapped: share of the pairs that are mirrored left to right, and that run backwards, from the current
            scan to the last one.
        points: number of points of the current cloud in the loss, drawn anew each time; 0 takes all.
        balanced: share of them that is drawn in equal numbers from points whose normals lie mainly along x, y and z.

    Raises:
        ConfigError: a value is out of range.
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
        check_not_negative(self, "weight_decay", "clip_norm", "points")
        check_not_negative(self, "initial_noise_rad", "initial_noise_m", "velocity_noise_m_s")
        check_fraction(self, "mirrored", "swapped", "balanced")
        betas = self.betas
        check_setting(
            self, "betas", len(betas) == 2 and all(0 <= b < 1 for b in betas), "two numbers from 0 to below 1"
        )


@dataclass(frozen=True)
class Recipe:
    """All settings of a training run.

    Attributes:
        name: name of the preset it is based on.
        network, loss, optimiser: the settings.
    """

    name: str = "custom"
    network: NetworkSettings = field(default_factory=NetworkSettings)
    loss: LossSettings = field(default_factory=LossSettings)
    optimiser: OptimiserSettings = field(default_factory=OptimiserSettings)


def _check_choices(settings: Any) -> None:
    for name, hint in typing.get_type_hints(type(settings)).items():
        if typing.get_origin(hint) is Literal and getattr(settings, name) not in typing.get_args(hint):
            choices = ", ".join(typing.get_args(hint))
            raise SettingError(
                type(settings).__name__, name, f"must be one of {choices}, got {getattr(settings, name)!r}"
            )
