"""The residual pose from two pairs of maps: a siamese ResNet encoder, pooling, a fully connected layer, attention.

Source: UnDeepLIO, "Estimating residual relative pose from the remapped maps". The encoder's sizes are not in the paper;
they are settings. Columns wrap around: convolutions are padded circularly along them, by zeros along rows.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from hybridlio.learned.networks import maps
from hybridlio.learned.networks import torch_se3 as se3
from hybridlio.learned.networks.attention import make_head
from hybridlio.learned.networks.layers import CircularConv, rotation_matrix
from hybridlio.learned.settings import NetworkSettings

_GROUP = 8  # channels per normalisation group: divides the channel counts of the default network
_MORE_CHANNELS = {"none": 0, "distance": 1, "gradient": 7}  # d; or d and the six columns of its gradient
_DISTANCE_M = 0.1  # input scale: typical error after an initial pose, so that inputs are of order 1
_LEVER_M = 10.0  # typical range of a point: scales gradients by rotation to those by translation
# Twice the error of perturbed initial poses. The pooled d·n then correlates with an error ahead at 0.93; without a
# kernel at 0.72 (240 validation pairs of benchmarks/published_data.py).
_KERNEL_M = 0.3
# A gradient pooled over the map is proportional to the share of cells that constrain its direction: on roads 1/12 as
# many face ahead as lie flat, and 1/4 as many face sideways. The gains make all directions about equal. With them, and
# an encoder that is not trained, a linear fit of its features follows an error ahead at a correlation of 0.74.
_GAINS = (20.0, 6.0, 2.0, 2.0, 1.0, 2.0)  # x, y, z, roll, pitch, yaw


class BasicBlock(nn.Module):
    """Two convolutions of 3 × 3 beside a shortcut (He et al., "Deep residual learning for image recognition", 2016)."""

    def __init__(self, inputs: int, outputs: int, stride: tuple[int, int], settings: NetworkSettings) -> None:
        super().__init__()
        bare = settings.normalisation == "none"
        self.first = CircularConv(inputs, outputs, 3, stride, bare)
        self.first_norm = _norm(outputs, settings)
        self.second = CircularConv(outputs, outputs, 3, (1, 1), bare)
        if bare:  # a block starts as its shortcut, so that activations keep their scale without normalisation
            nn.init.zeros_(self.second.conv.weight)
        self.second_norm = _norm(outputs, settings)
        same = inputs == outputs and stride == (1, 1)
        self.shortcut = (
            nn.Identity()
            if same
            else nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=bare), _norm(outputs, settings))
        )

    def forward(self, x: Tensor) -> Tensor:
        """Return maps of ``outputs`` channels."""
        inner = torch.relu(self.first_norm(self.first(x)))
        return torch.relu(self.second_norm(self.second(inner)) + self.shortcut(x))


class Encoder(nn.Module):
    """Stem, stages, average pooling and a fully connected layer: maps ``(B, C, H, W)`` to features ``(B, features)``.

    Every stage halves the columns, and the rows but in the first: a map has far more columns than rows. The stem halves
    the columns too, unless the settings say more.
    """

    def __init__(self, inputs: int, settings: NetworkSettings) -> None:
        super().__init__()
        self.pooled_columns = settings.pooled_columns
        self.stem = CircularConv(inputs, settings.stem, 7, settings.stem_stride, settings.normalisation == "none")
        self.stem_norm = _norm(settings.stem, settings)
        layers, channels = [], settings.stem
        for stage, outputs in enumerate(settings.stages):
            stride = (1 if stage == 0 else 2, 2)
            layers.append(BasicBlock(channels, outputs, stride, settings))
            layers += [BasicBlock(outputs, outputs, (1, 1), settings) for _ in range(settings.blocks - 1)]
            channels = outputs
        self.stages = nn.Sequential(*layers)
        self.full = nn.Linear(channels * settings.pooled_columns, settings.features)

    def forward(self, x: Tensor) -> Tensor:
        """Return the features ``(B, features)`` of maps ``(B, C, H, W)``."""
        x = self.stages(torch.relu(self.stem_norm(self.stem(x))))
        pooled = functional.adaptive_avg_pool2d(x, (1, self.pooled_columns)).flatten(1)
        return self.full(pooled)  # type: ignore[no-any-return]


def sharing_convolutions(encoder: Encoder, settings: NetworkSettings) -> Encoder:
    """Return an encoder that shares the convolutions and linear layers of ``encoder``, with separate normalisation.

    Vertices and normals differ in their statistics: a shared batch normalisation would evaluate with running means of
    both, which fit neither.
    """
    other = Encoder(encoder.stem.conv.in_channels, settings)
    for name, module in encoder.named_modules():
        if isinstance(module, nn.Conv2d | nn.Linear):
            parent, _, child = name.rpartition(".")
            setattr(other.get_submodule(parent), child, module)
    return other


class ResidualNetwork(nn.Module):
    """The residual ``δT`` between the last scan's maps and the current one's, moved by the initial pose."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        self.vertex_encoder = Encoder(6 + _MORE_CHANNELS[settings.distance], settings)
        self.shared = settings.siamese == "shared"
        if settings.normals != "none":
            self.normal_encoder = (
                sharing_convolutions(self.vertex_encoder, settings) if self.shared else Encoder(6, settings)
            )
        more = settings.imu_hidden if settings.imu == "feature" else 0
        both = settings.features * (1 if settings.normals == "none" else 2)
        separate = settings.normals == "separate"
        # separate branches take one kind of IMU feature each; joined branches take both
        translation_size, rotation_size = (
            (settings.features + more, both + more) if separate else (both + 2 * more,) * 2
        )
        self.rotation_head = make_head(settings.head, rotation_size)
        self.translation_head = make_head(settings.head, translation_size) if separate else self.rotation_head
        self.translation = _last(translation_size, settings)
        self.rotation = _last(rotation_size, settings)

    def forward(
        self,
        last: tuple[Tensor, Tensor],
        current: tuple[Tensor, Tensor],
        imu_features: tuple[Tensor, Tensor] | None = None,
    ) -> Tensor:
        """Return residual poses ``δT`` ``(B, 4, 4)``.

        Args:
            last: vertex and normal maps ``(B, 3, H, W)`` of the last scan.
            current: those of the current scan, moved into the last scan's frame.
            imu_features: of acceleration and of angular velocity, ``(B, imu_hidden)`` each, with ``imu="feature"``.
        """
        scale_m, distances = self.settings.vertex_scale_m, self._distances(last, current[0])
        vertices = torch.cat([last[0] / scale_m, current[0] / scale_m, *distances], dim=1)
        parts = [self.vertex_encoder(vertices).float()]
        if self.settings.normals != "none":
            # shared convolutions take the same number of channels from either kind of map
            normals = torch.cat([last[1], current[1], *(distances if self.shared else [])], dim=1)
            parts.append(self.normal_encoder(normals).float())
        translation_parts = parts[:1] if self.settings.normals == "separate" else parts
        rotation_parts = parts
        if imu_features is not None:
            of_accel, of_gyro = imu_features
            separate = self.settings.normals == "separate"
            translation_parts = [*translation_parts, of_accel] if separate else [*parts, of_accel, of_gyro]
            rotation_parts = [*parts, of_gyro] if separate else [*parts, of_accel, of_gyro]
        t = self.translation(self.translation_head(torch.cat(translation_parts, dim=1)).float())
        angles = self.rotation(self.rotation_head(torch.cat(rotation_parts, dim=1)).float())
        scale = self.settings.output_scale
        return se3.make(rotation_matrix(scale * angles.float(), self.settings), scale * t.float())

    def _distances(self, last: tuple[Tensor, Tensor], current: Tensor) -> list[Tensor]:
        if self.settings.distance == "none":
            return []
        return [_distance(last, current, self.settings.distance == "gradient")]


def _distance(last: tuple[Tensor, Tensor], current: Tensor, gradient: bool) -> Tensor:
    """Return how far points ``(B, 3, H, W)`` lie from the planes of their cells; 0 without point or plane.

    The signed distance d is in units of 0.1 m and weighted by the Geman-McClure kernel, so that edges and moving
    objects do not outweigh the remaining error of an initial pose. Shape ``(B, 1, H, W)``; with ``gradient``
    ``(B, 7, H, W)``: also d·n and d·(p × n), with p in units of 10 m, each axis times its gain.
    """
    vertices, normals = last
    seen = maps.valid_cells(current)[:, None]
    distance = (normals * (current - vertices)).sum(dim=1, keepdim=True)
    weight = (1 + (distance / _KERNEL_M).square()).square()
    distance = torch.where(seen, distance / weight, 0.0) / _DISTANCE_M
    if not gradient:
        return distance
    turning = maps.cross(current / _LEVER_M, normals, dim=1)
    gains = torch.tensor(_GAINS, dtype=distance.dtype, device=distance.device)[:, None, None]
    return torch.cat([distance, distance * torch.cat([normals, turning], dim=1) * gains], dim=1)


def _norm(channels: int, settings: NetworkSettings) -> nn.Module:
    if settings.normalisation == "none":
        return nn.Identity()
    if settings.normalisation == "batch":
        return nn.BatchNorm2d(channels)
    return nn.GroupNorm(max(channels // _GROUP, 1) if channels % _GROUP == 0 else 1, channels)


def _last(inputs: int, settings: NetworkSettings) -> nn.Linear:
    """The layer that a pose is read off: it starts near zero, so that training starts from the initial pose."""
    layer = nn.Linear(inputs, 3)
    with torch.no_grad():
        layer.weight *= settings.residual_scale
        layer.bias.zero_()
    return layer
