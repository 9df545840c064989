"""Matches between points of the last scan and of the current one.

Source: UnDeepLIO, "Loss Function" and table 5: nearest neighbours in the whole cloud (the method), among the points
that the maps show (Nubert et al.), or the same cell of both maps (Cho et al.). Matches are searched at a pose and then
fixed: no gradient goes through the search. It uses a k-d tree on a CPU and distances in chunks on a GPU.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.learned.networks import maps
from hybridlio.learned.networks import torch_se3 as se3
from hybridlio.learned.settings import LossSettings

_CHUNK = 1 << 26  # distances computed at once: 256 MiB, little beside a GPU's memory


@dataclass(frozen=True, eq=False)
class Clouds:
    """Points with normals of a batch of scans, padded to one size.

    Attributes:
        points: ``(B, K, 3)`` metres.
        normals: ``(B, K, 3)`` unit vectors; zero where a point has none.
        there: ``(B, K)`` true for points, false for padding.
    """

    points: Tensor
    normals: Tensor
    there: Tensor

    @classmethod
    def of_maps(cls, vertices: Tensor) -> Clouds:
        """Return the points of vertex maps ``(B, 3, H, W)`` with their normals; empty cells are padding."""
        normals = maps.normal_map(vertices)
        return cls(maps.as_points(vertices), maps.as_points(normals), maps.valid_cells(vertices).flatten(1))


@dataclass(frozen=True, eq=False)
class Matches:
    """Matched points of a batch, N for each pair of scans; rows without a match have the weight 0.

    Attributes:
        source, source_normals: ``(B, N, 3)`` of the current scan, in its own frame.
        target, target_normals: ``(B, N, 3)`` of the last scan, in its own frame.
        weight: ``(B, N)``, 1 for a match whose target has a normal, else 0.
        candidates: ``(B,)`` number of points that could have been matched.
    """

    source: Tensor
    source_normals: Tensor
    target: Tensor
    target_normals: Tensor
    weight: Tensor
    candidates: Tensor

    @property
    def share(self) -> Tensor:
        """``(B,)`` matched share of the candidates."""
        return self.weight.sum(1) / self.candidates.clamp(min=1)


@torch.no_grad()
def nearest(
    queries: Tensor, targets: Tensor, there: Tensor, max_distance_m: float = float("inf")
) -> tuple[Tensor, Tensor]:
    """Return index and distance ``(B, N)`` of the nearest target of each query.

    Args:
        queries: ``(B, N, 3)`` metres.
        targets: ``(B, M, 3)``.
        there: ``(B, M)`` which targets are points; without any, distances are infinite.
        max_distance_m: neighbours farther away may be returned at infinite distance, which shortens a CPU's search.
    """
    if queries.device.type != "cpu":
        return _by_distances(queries, targets, there)
    pairs = [_by_tree(q, t, h, max_distance_m) for q, t, h in zip(queries, targets, there, strict=True)]
    return torch.stack([index for index, _ in pairs]), torch.stack([distance for _, distance in pairs])


def _by_tree(queries: Tensor, targets: Tensor, there: Tensor, limit_m: float = float("inf")) -> tuple[Tensor, Tensor]:
    rows = np.flatnonzero(there.numpy())
    if not len(rows):
        return torch.zeros(len(queries), dtype=torch.int64), torch.full((len(queries),), torch.inf)
    asked = queries.detach().numpy()
    finite = np.isfinite(asked).all(axis=1)
    tree = cKDTree(targets.numpy()[rows], balanced_tree=False)
    distance, index = tree.query(
        np.where(finite[:, None], asked, 0.0), distance_upper_bound=limit_m, workers=torch.get_num_threads()
    )
    distance[~finite] = np.inf
    index[index == len(rows)] = 0  # no neighbour within the limit; its distance is infinite
    return torch.from_numpy(rows[index]), torch.from_numpy(distance.astype(np.float32))


def _by_distances(queries: Tensor, targets: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
    """Return index and distance ``(B, N)`` of the nearest target by all distances, of the whole batch at once."""
    best = []
    for part in torch.split(queries, max(_CHUNK // max(targets.shape[0] * targets.shape[1], 1), 1), dim=1):
        # exact mode: distances by matrix products are off by centimetres at ranges of 100 m
        distance = torch.cdist(part, targets, compute_mode="donot_use_mm_for_euclid_dist")
        best.append(distance.masked_fill_(~there[:, None], torch.inf).min(dim=2))
    return torch.cat([b.indices for b in best], dim=1), torch.cat([b.values for b in best], dim=1)


def match_nearest(pose: Tensor, last: Clouds, current: Clouds, max_distance_m: float = float("inf")) -> Matches:
    """Match each point of the current clouds, moved by the pose ``(B, 4, 4)``, with the nearest of the last clouds."""
    moved = se3.transform(pose.detach(), current.points)
    index, distance = nearest(moved, last.points, last.there, max_distance_m)
    rows = index[..., None].expand(-1, -1, 3)
    target, normals = last.points.gather(1, rows), last.normals.gather(1, rows)
    near = current.there & (distance < max_distance_m) & normals.any(-1)
    candidates = current.there.sum(1)
    return Matches(current.points, current.normals, target, normals, near.to(target.dtype), candidates)


def match_same_pixel(
    pose: Tensor, last: Clouds, current: Clouds, geometry: MapGeometry, max_distance_m: float = float("inf")
) -> Matches:
    """Match each cell of the last maps with the point of the current maps, moved by the pose, that falls into it.

    Args:
        pose: ``(B, 4, 4)``.
        last, current: of :meth:`Clouds.of_maps`.
        geometry: cells of the maps.
        max_distance_m: matches farther apart are left out.
    """
    moved = se3.transform(pose.detach(), current.points)
    moved = torch.where(current.there[..., None], moved, 0.0)
    chosen = maps.winners(moved, geometry)
    rows = chosen.clamp(min=0)[..., None].expand(-1, -1, 3)
    distance = (moved.gather(1, rows) - last.points).norm(dim=-1)
    near = (chosen >= 0) & last.there & (distance < max_distance_m) & last.normals.any(-1)
    source, normals = current.points.gather(1, rows), current.normals.gather(1, rows)
    candidates = (chosen >= 0).sum(1)
    return Matches(source, normals, last.points, last.normals, near.to(source.dtype), candidates)


def match(pose: Tensor, last: Clouds, current: Clouds, settings: LossSettings, geometry: MapGeometry) -> Matches:
    """Match by the method of the settings. For all but ``nearest``, the clouds must be those of the maps."""
    if settings.matching == "same-pixel":
        return match_same_pixel(pose, last, current, geometry, settings.max_distance_m)
    return match_nearest(pose, last, current, settings.max_distance_m)
