"""The whole network: initial pose, remapping, residual, ``T = δT·T̂``. Source: UnDeepLIO, "Network Structure"."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hybridlio.core.errors import ConfigError
from hybridlio.learned.networks import maps
from hybridlio.learned.networks import torch_se3 as se3
from hybridlio.learned.networks.imu_network import ImuNetwork
from hybridlio.learned.networks.network_types import NetworkInput, NetworkOutput, ScanMaps
from hybridlio.learned.networks.projective_steps import ProjectiveSteps
from hybridlio.learned.networks.residual_network import ResidualNetwork
from hybridlio.learned.settings import NetworkSettings


class OdometryNetwork(nn.Module):
    """UnDeepLIO: from two vertex maps and the IMU samples between them to the relative pose ``T_k_k1``.

    Args:
        settings: its structure.

    Attributes:
        mixed_precision: encoders compute in bfloat16; geometry and poses never do.
    """

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        self.mixed_precision = False
        self.imu_network = ImuNetwork(settings) if settings.imu in ("initial-pose", "feature") else None
        self.projective = ProjectiveSteps(settings) if settings.projective_steps else None
        self.residual_network = ResidualNetwork(settings) if settings.encoder else None

    def forward(self, given: NetworkInput) -> NetworkOutput:
        """Estimate the relative poses of a batch.

        Raises:
            ConfigError: the maps have another geometry than the network's, or a required initial pose is missing.
        """
        geometry = self.settings.geometry
        if given.last.shape[-2:] != (geometry.rows, geometry.columns):
            rows, columns = given.last.shape[-2:]
            raise ConfigError(
                f"the network takes maps of {geometry.rows} x {geometry.columns} cells, got {rows} x {columns}"
            )
        initial, features = self._from_imu(given)
        start = initial if given.perturbation is None else initial @ given.perturbation
        refined = self.refine(given, start, features)
        # The loss sees the IMU network's own pose, without the perturbation; a given initial pose includes it.
        return refined if self.settings.imu == "given" else NetworkOutput(initial, refined.poses)

    def refine(
        self, given: NetworkInput, initial: Tensor, features: tuple[Tensor, Tensor] | None = None
    ) -> NetworkOutput:
        """Refine initial poses ``(B, 4, 4)`` from any source; ``features`` are those of :meth:`imu_features`."""
        return self.refine_encoded(self.encode(given.last), self.encode(given.current), initial, features)

    def encode(self, vertices: Tensor) -> ScanMaps:
        """Compute everything that depends on one scan only from its vertex map ``(B, 3, H, W)``."""
        normals = maps.normal_map(vertices)
        points = None if self.projective is None else self.projective.encode(vertices, normals)
        return ScanMaps(vertices, normals, points)

    def refine_encoded(
        self, last: ScanMaps, current: ScanMaps, initial: Tensor, features: tuple[Tensor, Tensor] | None = None
    ) -> NetworkOutput:
        """Refine as :meth:`refine` does, from scans that :meth:`encode` returned."""
        pose, poses = initial, []
        for _ in range(self.settings.iterations):
            if self.projective is not None and last.points is not None and current.points is not None:
                poses += self.projective(last.points, current.points, pose)
                pose = poses[-1]
            if self.residual_network is not None:
                at = pose if self.settings.remap_gradient else pose.detach()
                moved = maps.remap(current.vertices, current.normals, at, self.settings.geometry)
                with torch.autocast(pose.device.type, torch.bfloat16, enabled=self.mixed_precision):
                    residual = self.residual_network((last.vertices, last.normals), moved, features)
                pose = residual.float() @ pose
                poses.append(pose)
        return NetworkOutput(initial, tuple(poses))

    def imu_features(self, imu: Tensor, velocity_m_s: Tensor) -> tuple[Tensor, Tensor] | None:
        """Return IMU features for the residual network, None unless ``imu="feature"``. See :class:`NetworkInput`."""
        if self.imu_network is None or self.settings.imu != "feature":
            return None
        return self.imu_network.features(imu, velocity_m_s)

    def _from_imu(self, given: NetworkInput) -> tuple[Tensor, tuple[Tensor, Tensor] | None]:
        if self.settings.imu == "given":
            if given.initial is None:
                raise ConfigError("this network (imu='given') needs an initial pose; set NetworkInput.initial")
            return given.initial, None
        nothing = se3.identity(len(given.last), given.last)
        if self.imu_network is None:
            return nothing, None
        if self.settings.imu == "feature":
            return nothing, self.imu_features(given.imu, given.velocity_m_s)
        return self.imu_network(given.imu, given.velocity_m_s, given.dt_s), None


def parameter_count(network: nn.Module) -> int:
    """Return the number of trained parameters; shared ones count once."""
    return sum(parameter.numel() for parameter in network.parameters())
