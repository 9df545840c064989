"""Whether a scan really says something of a direction of which its Hessian says little.

Normals are estimates: on a smooth wall some lean to one side and some to the other, at its edges far, and each pretends
to know a little of the way along it. A few trunks in an open field know no more by the Hessian's count. The difference
shows a step away, where points find other neighbours: the cost of trunks rises, whereas leaning normals are no worse
there than here. So the cost is looked at half a metre to either side, where all other directions have found their
minimum anew; a parabola through the three says where the minimum is, and the scatter of the points' rises how surely.

Who does not know to a few decimetres where to start may ask more: what the costs up to two metres off make likely.

A lidar's own pattern goes with it: where its rings fall on the ground, and by how much each beam is off, is the same
from scan to scan. A scan lies best on another alone where it has not moved from it. Between smooth walls such minima
were up to twelve times as deep as their scatter; so a minimum where the only other scan was is no sign.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridlio.core import se3
from hybridlio.core.arrays import Array
from hybridlio.registration.icp import Registration, RegistrationSettings, register
from hybridlio.registration.information import UNKNOWN_SIGMA_M, covariance_of, weak_basis
from hybridlio.registration.surface import Surface

_STEP_M = 0.5  # more than neighbours lie apart, so that points find others there
_STEPS = 6  # down the other directions, there
_SEEN = 4.5  # times the scatter: between smooth walls the rise was at most 3.5 times that, in a field 6 and more
_NARROW = 0.3  # of the kernel, where points are brought to points
_SEEN_SCALE = 6.0  # of a seen direction's variance: the few points that see it stand on a few trunks, and share errors
_OPEN = 3  # weak directions on open ground: ahead, sideways, the turn
_NEAR_SCALE = 20.0  # the same of points brought to points
_NEAR_M = 0.1  # a parabola through costs half a metre apart is good for so far
_ROUNDS = 4
_OFFSETS_M = np.linspace(-2.0, 2.0, 9)
_TEMPER = 1.5  # times the scatter of a rise that makes a place e times less likely: so σ was true between smooth walls
_SHARED = 2.0  # times the variance: the errors of what is weighed are alike from scan to scan, as the scene is
_OWN_PATTERN_M = 0.5  # from a scan: there its own pattern may be what matches
_TOLD = 0.9  # a variance that is hardly less than that of knowing nothing tells nothing


@dataclass(frozen=True, eq=False)
class Observed:
    """A registration, and what its points say of the directions that they constrain little.

    Attributes:
        found: the registration. Along what is not seen its pose is as it was guessed.
        basis: ``(6, D)`` the weak directions, orthonormal in the units of
            :func:`hybridlio.registration.information.scaled_spectrum`; mostly there are none.
        along: ``(D, 6)`` tangent vectors: how the pose changes for each metre that it is taken along one. Between walls
            that bend it turns.
        seen: ``(D,)`` of which of them the points surely say something.
        sigmas_m: ``(D,)`` standard deviation along each, 10 m where nothing is known.
        normal_noise: how much of a point's information, per point, its normal's noise pretends.
    """

    found: Registration
    basis: Array
    along: Array
    seen: NDArray[np.bool_]
    sigmas_m: Array
    normal_noise: float

    @property
    def degenerate(self) -> Array:
        """``(U, 6)`` unit tangent directions that they say nothing of."""
        unseen = self.along[~self.seen]
        return np.asarray(unseen / np.linalg.norm(unseen, axis=1, keepdims=True))

    def covariance(self, scale: float) -> Array:
        """``(6, 6)`` rad² and m², rotation first: of the strong directions, and along the weak ones.

        Args:
            scale: how much larger that of the strong directions is than independent points would make it.
        """
        found = self.found
        strong = covariance_of(found.hessian, found.sigma_m, scale, found.levers_m, self.normal_noise, held=self.basis)
        weak = self.along * np.minimum(self.sigmas_m, UNKNOWN_SIGMA_M)[:, None]
        return np.asarray(strong + weak.T @ weak)


def observe(
    surface: Surface,
    source: Array,
    initial: Array,
    settings: RegistrationSettings,
    kernel_start_m: float = 0.0,
    far: bool = False,
    alone: Array | None = None,
    points: Array | None = None,
) -> Observed:
    """Register by the strong directions; along a weak one go to the parabola's minimum, where the points see it at all.

    From there what thin things there are says more, point by point, under a kernel too narrow to find the way there.

    Args:
        surface, source, initial, settings, kernel_start_m: as of :func:`hybridlio.registration.icp.register`.
        far: nobody knows ``initial`` to a few decimetres: along what is not seen, weigh the costs farther off.
        alone: ``(4, 4)`` where the one scan was that ``surface`` is made of; None for several.
        points: ``(M, 3)`` more of the scan's, which tell more of thin things; by default ``source``.
    """
    found = register(surface, source, initial, settings, kernel_start_m)
    noise = surface.normal_noise
    basis, to_tangent = weak_basis(found.hessian, found.levers_m, noise.most)
    if not basis.shape[1]:
        return Observed(found, basis, np.empty((0, 6)), np.empty(0, dtype=bool), np.empty(0), noise.mean)
    beside = _Beside(surface, source, settings, basis, to_tangent, alone)
    weak = beside.look(found)
    for _ in range(_ROUNDS):
        if not weak.way_m.any():
            break
        found = beside.register(found.pose @ se3.exp(weak.way_m @ weak.along), settings)
        if np.abs(weak.way_m).max() < _NEAR_M:
            break
        weak = beside.look(found)
    seen = np.isfinite(weak.sigmas_m) & (not beside.may_match_itself(found.pose))
    found, sigmas_m = beside.closer(found, weak.sigmas_m, seen, source if points is None else points)
    sigmas_m = np.where(seen, sigmas_m, UNKNOWN_SIGMA_M)
    if far and not seen.all():
        ways_m, here = np.zeros(len(seen)), beside.costs(found.pose)
        for i in np.flatnonzero(~seen):
            ways_m[i], sigmas_m[i] = beside.weigh(found, here, weak.along[i])
        found = beside.register(found.pose @ se3.exp(ways_m @ weak.along), settings)
    return Observed(found, basis, weak.along, seen, sigmas_m, noise.mean)


@dataclass(frozen=True, eq=False)
class _Weak:
    """What was seen beside a pose: ways to the minima ``(D,)``, and as in :class:`Observed`."""

    way_m: Array
    along: Array
    sigmas_m: Array


@dataclass(frozen=True, eq=False)
class _Beside:
    """Looks at the costs beside a pose along ``basis``, where the strong directions have found their minimum anew."""

    surface: Surface
    source: Array
    settings: RegistrationSettings
    basis: Array
    to_tangent: Array
    alone: Array | None

    def look(self, found: Registration) -> _Weak:
        """At both sides of ``found``, along each weak direction."""
        here, count = self.costs(found.pose), self.basis.shape[1]
        weak = _Weak(np.empty(count), np.empty((count, 6)), np.empty(count))
        for i, direction in enumerate((self.to_tangent[:, None] * self.basis).T):
            back, rises_back = self._step(found.pose, here, -_STEP_M * direction)
            ahead, rises_ahead = self._step(found.pose, here, _STEP_M * direction)
            weak.along[i] = se3.log(se3.between(back, ahead)) / (2 * _STEP_M)
            weak.way_m[i], weak.sigmas_m[i] = _minimum(rises_back, rises_ahead)
        return weak

    def weigh(self, found: Registration, here: Array, direction: Array) -> tuple[float, float]:
        """Metres along ``direction`` to where the costs make it likely to be, and their standard deviation.

        ``here`` are the costs at the pose found. Each offset's likelihood falls with its rise over the rise's scatter.
        What the choice of offsets pretends to know is taken out again, as of a product of two normal distributions.
        """
        tries = [self._step(found.pose, here, offset_m * direction) for offset_m in _OFFSETS_M]
        depth = np.array([r.sum() / np.sqrt(r @ r + 1e-12) for _, r in tries]) / _TEMPER
        trusted = np.array([not self.may_match_itself(pose) for pose, _ in tries])
        if not trusted.any():
            return 0.0, UNKNOWN_SIGMA_M
        between = np.interp(_OFFSETS_M, _OFFSETS_M[trusted], depth[trusted])
        depth = np.where(trusted, depth, np.maximum(depth, between))
        weights = np.exp(depth.min() - depth)
        weights /= weights.sum()
        mean = float(weights @ _OFFSETS_M)
        apart_m = _OFFSETS_M[1] - _OFFSETS_M[0]
        variance = float(weights @ (_OFFSETS_M - mean) ** 2) + apart_m**2 / 12
        unknown = float((_OFFSETS_M**2).mean())
        if variance > _TOLD * unknown:
            return 0.0, UNKNOWN_SIGMA_M
        told = 1 / (1 / variance - 1 / unknown)
        return mean / variance * told, float(np.sqrt(_SHARED * told))

    def may_match_itself(self, pose: Array) -> bool:
        """Whether the scan would lie so near to the only other one that its pattern falls on that one's."""
        if self.alone is None:
            return False
        return bool(np.linalg.norm(pose[:3, 3] - self.alone[:3, 3]) < _OWN_PATTERN_M)

    def closer(
        self, found: Registration, wide_sigmas_m: Array, seen: NDArray[np.bool_], points: Array
    ) -> tuple[Registration, Array]:
        """``found``, at where ``points`` lie nearest, and standard deviations ``(D,)`` along what is ``seen``.

        ``wide_sigmas_m`` are those of the minimum seen, as of independent points. It stands but in the open, where all
        of the ground is seen: beside walls what makes no plane is mostly their edges, along which points lie near by
        chance. And it stands where one does not come to the same place from either side.
        """
        if len(seen) < _OPEN or not seen.all():
            return found, np.sqrt(_SEEN_SCALE) * wide_sigmas_m
        held, narrow = np.empty((6, 0)), replace(self.settings, kernel_m=_NARROW * self.settings.kernel_m)
        beside = _NEAR_M * self.to_tangent * self.basis.sum(axis=1)
        near, other = (
            register(
                self.surface, points, found.pose @ se3.exp(way), narrow, self.settings.kernel_m, held,
                thick_as_points=True,
            )
            for way in (beside, -beside)
        )  # fmt: skip
        to_weak = (self.basis / self.to_tangent[:, None]).T
        apart_m, way_m = (to_weak @ se3.log(se3.between(near.pose, pose)) for pose in (other.pose, found.pose))
        if np.abs(apart_m).max() > narrow.kernel_m or np.abs(way_m).max() > _STEP_M:
            return found, np.sqrt(_SEEN_SCALE) * wide_sigmas_m
        noise = self.surface.normal_noise.mean
        covariance = covariance_of(near.hessian, near.sigma_m, _NEAR_SCALE, found.levers_m, noise)
        sigmas_m = np.sqrt(np.einsum("ij,jk,ik->i", to_weak, covariance, to_weak))
        return replace(found, pose=near.pose), sigmas_m

    def register(self, pose: Array, settings: RegistrationSettings) -> Registration:
        """Down the strong directions alone."""
        return register(self.surface, self.source, pose, settings, held=self.basis)

    def _step(self, pose: Array, here: Array, step: Array) -> tuple[Array, Array]:
        """The pose a step away, and by how much the points' costs are higher there."""
        there = self.register(pose @ se3.exp(step), replace(self.settings, max_iterations=_STEPS)).pose
        rises = self.costs(there) - here
        return there, np.asarray(rises[~np.isnan(rises)])

    def costs(self, pose: Array) -> Array:
        """``(N,)`` robust cost of each point, between 0 and 1; NaN without a neighbour."""
        moved = se3.transform(pose, self.source)
        index, distance2 = self.surface.nearest(moved, self.settings.threads)
        r2 = np.einsum("ij,ij->i", moved - self.surface.points[index], self.surface.normals[index]) ** 2
        return np.where(distance2 < self.settings.max_distance_m**2, r2 / (self.settings.kernel_m**2 + r2), np.nan)


def _minimum(back: Array, ahead: Array) -> tuple[float, float]:
    """Metres to the parabola's minimum and their standard deviation; infinite where points do not see it.

    Then, where costs clearly fall to one side, that side is where to look on.
    """
    rise, scatter = float(back.sum() + ahead.sum()), float(np.sqrt(back @ back + ahead @ ahead))
    if rise <= _SEEN * scatter:
        return _STEP_M * (_falls(ahead) - _falls(back)), np.inf
    way_m = _STEP_M * float(back.sum() - ahead.sum()) / (2 * rise)
    return float(np.clip(way_m, -_STEP_M, _STEP_M)), _STEP_M * scatter / (2 * rise)


def _falls(rises: Array) -> bool:
    return bool(rises.sum() < -_SEEN * np.sqrt(rises @ rises))
