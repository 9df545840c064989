"""Which point of the last scan goes with which of the current one.

Source: UnDeepLIO, "Loss Function" and table 5: nearest neighbours in the whole cloud (the method), among the points
that the maps show (Nubert et al.), or the same cell of both maps (Cho et al.). Matches are looked for at a pose and
then held fixed: no gradient goes through the choice. A KD-tree finds neighbours on a CPU, chunked distances on a GPU.
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

_CHUNK = 1 << 26  # distances on the device at once: 256 MiB


@dataclass(frozen=True, eq=False)
class Clouds:
    """Points with normals of a batch of scans, padded to one size.

    Attributes:
        points: ``(B, K, 3)`` metres.
        normals: ``(B, K, 3)`` unit vectors; zero where a point has none.
        there: ``(B, K)`` whether a row is a point, not padding.
    """

    points: Tensor
    normals: Tensor
    there: Tensor

    @classmethod
    def of_maps(cls, vertices: Tensor) -> Clouds:
        """What vertex maps ``(B, 3, H, W)`` show, with the normals of their normal maps; empty cells are padding."""
        normals = maps.normal_map(vertices)
        return cls(maps.as_points(vertices), maps.as_points(normals), maps.valid_cells(vertices).flatten(1))


@dataclass(frozen=True, eq=False)
class Matches:
    """Pairs of points, as many for each of the batch; those of no weight count for nothing.

    Attributes:
        source, source_normals: ``(B, N, 3)`` of the current scan, in its own frame.
        target, target_normals: ``(B, N, 3)`` of the last scan, in its own frame.
        weight: ``(B, N)``, 1 where there is a match whose target has a normal, else 0.
        candidates: ``(B,)`` how many points might have been matched.
    """

    source: Tensor
    source_normals: Tensor
    target: Tensor
    target_normals: Tensor
    weight: Tensor
    candidates: Tensor

    @property
    def share(self) -> Tensor:
        """``(B,)`` matched of all candidates."""
        return self.weight.sum(1) / self.candidates.clamp(min=1)


@torch.no_grad()
def nearest(
    queries: Tensor, targets: Tensor, there: Tensor, max_distance_m: float = float("inf")
) -> tuple[Tensor, Tensor]:
    """Index and distance ``(B, N)`` of the nearest of the targets to each query.

    Args:
        queries: ``(B, N, 3)`` metres.
        targets: ``(B, M, 3)``.
        there: ``(B, M)`` which targets count; where none does, distances are infinite.
        max_distance_m: those farther away may be given as infinitely far, which saves a CPU looking for them.
    """
    if queries.device.type == "cpu":
        pairs = [_by_tree(q, t, h, max_distance_m) for q, t, h in zip(queries, targets, there, strict=True)]
    else:
        pairs = [_by_distances(q, t, h) for q, t, h in zip(queries, targets, there, strict=True)]
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
    index[index == len(rows)] = 0  # none as near
    return torch.from_numpy(rows[index]), torch.from_numpy(distance.astype(np.float32))


def _by_distances(queries: Tensor, targets: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
    best = []
    for part in torch.split(queries, max(_CHUNK // max(len(targets), 1), 1)):
        # the exact mode: by matrix products, neighbours at 100 m would be off by centimetres
        distance = torch.cdist(part, targets, compute_mode="donot_use_mm_for_euclid_dist")
        best.append(distance.masked_fill_(~there, torch.inf).min(dim=1))
    return torch.cat([b.indices for b in best]), torch.cat([b.values for b in best])


def match_nearest(pose: Tensor, last: Clouds, current: Clouds, max_distance_m: float = float("inf")) -> Matches:
    """Each point of the current clouds, moved by the pose ``(B, 4, 4)``, with the nearest of the last ones."""
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
    """Each cell of the last maps with what the current maps, moved by the pose, show in it.

    Args:
        pose: ``(B, 4, 4)``.
        last, current: of :meth:`Clouds.of_maps`.
        geometry: cells of the maps.
        max_distance_m: matches farther apart do not count.
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
    """Matches as the settings say. For all but ``nearest`` the clouds are those of the maps."""
    if settings.matching == "same-pixel":
        return match_same_pixel(pose, last, current, geometry, settings.max_distance_m)
    return match_nearest(pose, last, current, settings.max_distance_m)
