"""Rain and dust between the lidar and the surfaces: returns from drops and clouds, and light lost on the way.

The received power is that of :mod:`hybridlio.simulation.sensors.lidar`, reflectance · cos(incidence) / range². The
sensor reports the strongest return of each pulse.

**Rain.** Drops of diameter ``D`` are distributed as ``N(D) = 8000·exp(−ΛD)`` per m³ and mm, with
``Λ = 4.1·R^−0.21`` per mm at a rate ``R`` in mm/h (Marshall and Palmer, "The distribution of raindrops with size",
J. Meteorology 1948). They are much larger than the wavelength, so each takes twice its cross-section out of the beam:
the extinction is ``α = ∫ 2·(π/4)·D²·N dD = π·8000/Λ³``, and surfaces lose ``exp(−2αr)``. A single drop in the beam may
return enough to be seen. As in Kilic et al., "Lidar light scattering augmentation (LISA)", arXiv 2107.07004, drops are
drawn at random and return like a surface that fills the share ``(D/beam)²`` of the beam. The reflectance of a drop
follows from geometrical optics: a sphere reflects ``F = ((n−1)/(n+1))²`` at its front, and ``(1−F)²·F·(n/(2−n))²`` at
its back, evenly over all directions, which is a quarter of what a white disc of its size sends back: 0.024 for water,
n = 1.33.

**Dust.** A cloud of extinction ``α`` returns ``ρ·exp(−2αx)`` from the depth ``x``, with ``ρ = π·(α/S)·(cτ/2)`` for the
lidar ratio ``S`` and a pulse of length ``τ``. Its density fluctuates from pulse to pulse, so the depth of the return is
drawn with a density proportional to the power from there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridlio.core.arrays import Array, Index
from hybridlio.core.lidar_models import LidarModel
from hybridlio.simulation.sensors.lidar import FAINTEST_1_M2, RayPattern, world_rays
from hybridlio.simulation.world.rays import Hits

# Data sheet of the VLP-16: 3 mrad, and 1 cm at the sensor.
_DIVERGENCE_RAD, _APERTURE_M = 3e-3, 0.01
_DROPS_PER_M3_MM = 8000.0
_WATER_FRONT = ((1.33 - 1) / (1.33 + 1)) ** 2
_WATER_BACK = (1 - _WATER_FRONT) ** 2 * _WATER_FRONT * (1.33 / (2 - 1.33)) ** 2
_DROP_REFLECTANCE = (_WATER_FRONT + _WATER_BACK) / 4
_RAIN_REACH_M = 20.0  # beyond, a drop of 7 mm, the largest there are, is not seen
_LIDAR_RATIO_SR = 50.0  # of mineral dust: 40 to 60 (Tesche et al., Tellus B 2009, for the Sahara's)
_PULSE_M = 0.75  # c·τ/2 of a pulse of 5 ns
_DUST_REACH_M = 60.0  # a cloud's return is below the threshold there


@dataclass(frozen=True, eq=False)
class DustClouds:
    """Spherical clouds of even density that drift with the wind.

    Attributes:
        centres: ``(C, 3)`` metres, world frame, each at its own time.
        times_s: ``(C,)`` these times.
        wind_m_s: ``(3,)`` in world.
        radii_m: ``(C,)``.
        extinctions_1_m: ``(C,)`` extinction coefficients.
    """

    centres: Array
    times_s: Array
    wind_m_s: Array
    radii_m: Array
    extinctions_1_m: Array

    def centres_at(self, time_s: float) -> Array:
        """Return where the clouds are ``(C, 3)`` at a time."""
        return np.asarray(self.centres + np.outer(time_s - self.times_s, self.wind_m_s))


@dataclass(frozen=True, eq=False)
class Air:
    """What is in the air.

    Attributes:
        rain_mm_h: rate of the rain.
        dust: clouds of dust; None without.
    """

    rain_mm_h: float = 0.0
    dust: DustClouds | None = None

    @property
    def is_clear(self) -> bool:
        """Whether there is nothing in the air."""
        return self.rain_mm_h == 0 and self.dust is None


CLEAR = Air()


def look_through(
    air: Air, hits: Hits, pattern: RayPattern, poses: Array, time_s: float, model: LidarModel, rng: np.random.Generator
) -> None:
    """Change exact first hits, in place, to what a lidar sees through rain and dust.

    Args:
        air: what is in the air.
        hits: of the rays of ``pattern``.
        pattern: the rays.
        poses: as :func:`hybridlio.simulation.sensors.lidar.first_hits` takes them.
        time_s: of the scan, at which clouds are where they are.
        model: the lidar.
        rng: of drops and depths.
    """
    if air.dust is not None:
        _through_dust(air.dust, hits, pattern, poses, time_s, rng)
    if air.rain_mm_h > 0:
        _through_rain(air.rain_mm_h, hits, model, rng)


def rain_extinction_1_m(rain_mm_h: float) -> float:
    """Return the extinction coefficient of rain."""
    return float(np.pi * _DROPS_PER_M3_MM / _slope_1_mm(rain_mm_h) ** 3 * 1e-6)  # mm² to m²


def _slope_1_mm(rain_mm_h: float) -> float:
    return float(4.1 * rain_mm_h**-0.21)


def _beam_m(ranges_m: Array) -> Array:
    return _APERTURE_M + _DIVERGENCE_RAD * ranges_m


def _through_rain(rain_mm_h: float, hits: Hits, model: LidarModel, rng: np.random.Generator) -> None:
    _attenuate(hits, rain_extinction_1_m(rain_mm_h) * hits.range_m)
    rays, ranges_m, reflectances = _visible_drops(rain_mm_h, len(hits.range_m), model, rng)
    before = ranges_m < hits.range_m[rays]
    _return_strongest(hits, rays[before], ranges_m[before], reflectances[before])


def _visible_drops(
    rain_mm_h: float, rays: int, model: LidarModel, rng: np.random.Generator
) -> tuple[Index, Array, Array]:
    """Draw the drops that may be seen in the beams: ray, range, and share of a white surface's return, ``(N,)`` each.

    Along a beam they are a Poisson process, whose rate is the beam's section times the density of visible drops.
    """
    slope = _slope_1_mm(rain_mm_h)
    grid_m = np.linspace(model.min_range_m, _RAIN_REACH_M, 400)
    density = _DROPS_PER_M3_MM / slope * np.exp(-slope * _smallest_visible_mm(grid_m))
    rate_1_m = np.pi / 4 * _beam_m(grid_m) ** 2 * density
    expected = np.concatenate([[0.0], np.cumsum((rate_1_m[1:] + rate_1_m[:-1]) / 2 * np.diff(grid_m))])
    count = rng.poisson(expected[-1] * rays)
    ray = rng.integers(rays, size=count)
    ranges_m = np.interp(rng.random(count) * expected[-1], expected, grid_m)
    diameters_mm = _smallest_visible_mm(ranges_m) + rng.exponential(1 / slope, count)
    share = np.minimum(1e-3 * diameters_mm / _beam_m(ranges_m), 1.0) ** 2
    return ray, ranges_m, _DROP_REFLECTANCE * share


def _smallest_visible_mm(ranges_m: Array) -> Array:
    return np.asarray(1e3 * _beam_m(ranges_m) * ranges_m * np.sqrt(FAINTEST_1_M2 / _DROP_REFLECTANCE))


def _through_dust(
    dust: DustClouds, hits: Hits, pattern: RayPattern, poses: Array, time_s: float, rng: np.random.Generator
) -> None:
    middle = poses[len(poses) // 2]
    centres = (dust.centres_at(time_s) - middle[:3, 3]) @ middle[:3, :3]  # in the lidar's frame
    distances = np.linalg.norm(centres, axis=1)
    origins, directions = world_rays(pattern, poses)
    depth = np.zeros(len(hits.range_m))  # optical depth of the clouds before
    found: list[tuple[Index, Array, Array]] = []
    for cloud in np.argsort(distances):
        if distances[cloud] - dust.radii_m[cloud] > _DUST_REACH_M:
            continue
        rays = pattern.rays_near(centres[cloud], float(dust.radii_m[cloud]))
        enter, leave = _chord(
            origins[rays] - dust.centres_at(time_s)[cloud], directions[rays], float(dust.radii_m[cloud])
        )
        leave = np.minimum(leave, hits.range_m[rays])
        inside = leave > enter
        rays, enter, length = rays[inside], enter[inside], (leave - enter)[inside]
        alpha = float(dust.extinctions_1_m[cloud])
        into = -np.log1p(-rng.random(len(rays)) * -np.expm1(-2 * alpha * length)) / (2 * alpha)
        brightness = np.pi * alpha / _LIDAR_RATIO_SR * _PULSE_M
        found.append((rays, enter + into, brightness * np.exp(-2 * (depth[rays] + alpha * into))))
        depth[rays] += alpha * length
    _attenuate(hits, depth)
    for rays, ranges_m, reflectances in found:
        _return_strongest(hits, rays, ranges_m, reflectances)


def _chord(offsets: Array, directions: Array, radius_m: float) -> tuple[Array, Array]:
    """Return where rays enter and leave a sphere ``(R,)``; they leave before they enter where they miss it."""
    along = -np.einsum("ij,ij->i", offsets, directions)
    half2 = radius_m**2 - np.einsum("ij,ij->i", offsets, offsets) + along**2
    half = np.sqrt(np.maximum(half2, 0.0))
    return np.maximum(along - half, 0.0), np.where(half2 > 0, along + half, -1.0)


def _attenuate(hits: Hits, optical_depth: Array) -> None:
    seen = np.isfinite(optical_depth)
    hits.reflectance[seen] *= np.exp(-2 * optical_depth[seen])


def _return_strongest(hits: Hits, rays: Index, ranges_m: Array, reflectances: Array) -> None:
    """Replace the hits of rays by returns from the air that are stronger; a ray may occur several times."""
    order = np.argsort(reflectances / ranges_m**2, kind="stable")  # the strongest of a ray is written last
    rays, ranges_m, reflectances = rays[order], ranges_m[order], reflectances[order]
    power = hits.reflectance[rays] * hits.cosine[rays] / hits.range_m[rays] ** 2
    stronger = reflectances / ranges_m**2 > power
    rays = rays[stronger]
    hits.range_m[rays], hits.cosine[rays], hits.reflectance[rays] = ranges_m[stronger], 1.0, reflectances[stronger]
