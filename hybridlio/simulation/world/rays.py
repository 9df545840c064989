"""Ray casting against triangle meshes (Embree, through Open3D)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridlio.core.arrays import Array
from hybridlio.simulation.world.shapes import Mesh


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of ``R`` rays.

    Attributes:
        range_m: ``(R,)`` metres along the ray, infinite without a hit.
        cosine: ``(R,)`` of the angle of incidence, 0 without a hit.
        reflectance: ``(R,)`` of the surface, 0 without a hit.
    """

    range_m: Array
    cosine: Array
    reflectance: Array

    def take_nearer(self, rows: NDArray[np.intp], others: Hits) -> None:
        """Replace hits of the rays ``rows`` by ``others``, in place, where those are nearer."""
        nearer = others.range_m < self.range_m[rows]
        for mine, theirs in zip(vars(self).values(), vars(others).values(), strict=True):
            mine[rows[nearer]] = theirs[nearer]


@dataclass(eq=False)
class RayScene:
    """A mesh ready for ray casting. Coordinates are relative to ``origin`` ``(3,)``, because Embree uses float32."""

    origin: Array
    reflectance: Array
    scene: Any

    @classmethod
    def of(cls, mesh: Mesh, origin: Array) -> RayScene:
        """Build the scene of a mesh."""
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene()
        vertices = np.ascontiguousarray(mesh.vertices - origin, dtype=np.float32)
        triangles = np.ascontiguousarray(mesh.triangles, dtype=np.uint32)
        scene.add_triangles(o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(triangles))
        return cls(origin, np.append(mesh.reflectance, 0.0), scene)

    def cast(self, origins: Array, directions: Array) -> Hits:
        """Return the first hits of rays from ``origins`` along unit ``directions``, each ``(R, 3)`` in world."""
        import open3d as o3d

        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = origins - self.origin, directions
        answer = self.scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
        # a ray without a hit has an id beyond all faces; the reflectance appended above, 0, is for these
        faces = np.minimum(answer["primitive_ids"].numpy(), len(self.reflectance) - 1)
        normals = answer["primitive_normals"].numpy()
        cosine = np.abs(np.einsum("ni,ni->n", normals, rays[:, 3:]))
        return Hits(answer["t_hit"].numpy().astype(np.float64), cosine, self.reflectance[faces])
