"""Preparation of a scan: motion compensation, cropping, and derived maps, normals and thinned clouds on demand.

The network needs vertex and normal maps; the training loss needs normals, ground and an averaged cloud. Each is
computed when it is first read, and cached.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from hybridlio.cloud.deskew import deskew
from hybridlio.cloud.ground import GroundOptions, GroundPlane, find_ground
from hybridlio.cloud.map_geometry import MAP_GEOMETRIES, MapGeometry
from hybridlio.cloud.normals import estimate_normals
from hybridlio.cloud.projection import normal_map, vertex_map
from hybridlio.cloud.voxel import VoxelCloud, voxel_average, voxel_to_count
from hybridlio.core.arrays import Floats
from hybridlio.core.errors import ConfigError
from hybridlio.core.sensors import Scan
from hybridlio.core.trajectory import Trajectory


@dataclass(frozen=True)
class PreparationOptions:
    """Settings of the preparation.

    Attributes:
        min_range_m, max_range_m: points outside are dropped (the vehicle itself, stray returns).
        min_points: a scan with fewer points after cropping is not usable.
        geometry: cells of the vertex and normal maps.
        thinned_voxel_m: side of the voxels of the thinned cloud.
        normal_neighbours, normal_thin_m: of :func:`hybridlio.cloud.normals.estimate_normals`.
        remove_ground: whether ground is removed from the loss cloud, as in the paper.
        ground: settings of the ground segmentation.
        loss_points, loss_tolerance: size of the loss cloud; the paper's K = 10,240 ± 100.
        loss_voxel_m: voxel side tried first for that size; the paper's 0.3 m.
        threads: for the neighbour search of the normals.
    """

    min_range_m: float = 1.0
    max_range_m: float = 120.0
    min_points: int = 100
    geometry: MapGeometry = MAP_GEOMETRIES["hdl-64e"]
    thinned_voxel_m: float = 0.5
    normal_neighbours: int = 20
    normal_thin_m: float = 0.2
    remove_ground: bool = True
    ground: GroundOptions = field(default_factory=GroundOptions)
    loss_points: int = 10240
    loss_tolerance: int = 100
    loss_voxel_m: float = 0.3
    threads: int = 2

    def __post_init__(self) -> None:
        if not 0 <= self.min_range_m < self.max_range_m:
            raise ConfigError(
                f"preparation: need 0 <= min_range_m < max_range_m, got {self.min_range_m} and {self.max_range_m}"
            )
        if not self.thinned_voxel_m > 0:
            raise ConfigError(f"preparation: thinned_voxel_m must be positive, got {self.thinned_voxel_m}")


@dataclass(frozen=True, eq=False)
class PreparedScan:
    """A scan in the lidar frame at its stamp, and parts derived from it, each computed when it is first read.

    Attributes:
        scan: compensated and cropped; ``scan.time_offsets_ns`` is not None only if no motion was given.
        options: settings of the preparation.
    """

    scan: Scan
    options: PreparationOptions

    @property
    def stamp_ns(self) -> int:
        """The scan's stamp."""
        return self.scan.stamp_ns

    @property
    def points(self) -> Floats:
        """``(N, 3)`` metres, the points within range."""
        return self.scan.points

    @property
    def usable(self) -> bool:
        """Whether enough points are left to estimate a pose; otherwise the scan has to be bridged."""
        return len(self.scan) >= self.options.min_points

    @cached_property
    def thinned(self) -> Floats:
        """``(M, 3)`` the mean point of each voxel of ``thinned_voxel_m``."""
        return voxel_average(self.points, None, self.options.thinned_voxel_m)[0]

    @cached_property
    def vertex_map(self) -> Floats:
        """``(3, H, W)`` metres; 0 in empty cells."""
        return vertex_map(self.points, self.options.geometry)

    @cached_property
    def normal_map(self) -> Floats:
        """``(3, H, W)`` unit normals of the vertex map; 0 in cells without a normal."""
        return normal_map(self.vertex_map)

    @cached_property
    def normals(self) -> Floats:
        """``(N, 3)`` unit normals by plane fitting, towards the sensor; zero for unsupported points."""
        options = self.options
        return estimate_normals(self.points, options.normal_neighbours, options.threads, options.normal_thin_m)

    @cached_property
    def ground(self) -> GroundPlane:
        """The ground plane and the points on it; check ``ground.found``."""
        return find_ground(self.points, self.normals, self.options.ground)

    @cached_property
    def loss_cloud(self) -> VoxelCloud:
        """Points and normals for the loss, without ground, averaged to ``loss_points`` ± ``loss_tolerance`` points."""
        keep = ~self.ground.mask if self.options.remove_ground else slice(None)
        options = self.options
        return voxel_to_count(
            self.points[keep], self.normals[keep], options.loss_points, options.loss_tolerance, options.loss_voxel_m
        )


def prepare(scan: Scan, options: PreparationOptions | None = None, motion: Trajectory | None = None) -> PreparedScan:
    """Compensate the sweep's motion and drop points out of range.

    Args:
        scan: as the sensor delivered it. A scan without points is accepted; it is not ``usable``.
        options: settings of the preparation.
        motion: lidar poses around the sweep, see :func:`hybridlio.cloud.deskew.deskew`; used only if points have times.
            Without it such a scan stays as measured.

    Raises:
        DataError: the motion has fewer than two poses.
    """
    options = options or PreparationOptions()
    if motion is not None:
        scan = deskew(scan, motion)
    return PreparedScan(_crop(scan, options.min_range_m, options.max_range_m), options)


def _crop(scan: Scan, min_range_m: float, max_range_m: float) -> Scan:
    squared = np.einsum("ij,ij->i", scan.points, scan.points)
    keep = (squared >= np.float32(min_range_m) ** 2) & (squared <= np.float32(max_range_m) ** 2)
    return scan if keep.all() else scan.part(keep)
