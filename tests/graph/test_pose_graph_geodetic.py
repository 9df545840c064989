"""GPS fixes by latitude and longitude: positions in world, the origin, and files that keep it."""

from __future__ import annotations

import numpy as np
import pytest

from hybridlio.core import se3
from hybridlio.core.errors import DataError, GraphError
from hybridlio.core.geodesy import GeodeticPoint, geodetic_from_enu
from hybridlio.graph import PoseGraph

ORIGIN = GeodeticPoint(49.011, 8.416, 112.0)
PLACES = [(49.02, 8.43, 130.0), (48.99, 8.40, 90.0), (49.011, 8.45, 115.0)]


def earth_centred(latitude_deg: float, longitude_deg: float, height_m: float) -> np.ndarray:
    """Convert WGS 84 to earth-centred coordinates in closed form."""
    a, f = 6378137.0, 1 / 298.257223563
    phi, lam = np.radians([latitude_deg, longitude_deg])
    e2 = f * (2 - f)
    n = a / np.sqrt(1 - e2 * np.sin(phi) ** 2)
    level = (n + height_m) * np.cos(phi)
    return np.array([level * np.cos(lam), level * np.sin(lam), (n * (1 - e2) + height_m) * np.sin(phi)])


def east_north_up(place: tuple[float, float, float], origin: GeodeticPoint) -> np.ndarray:
    phi, lam = np.radians(origin[:2])
    east = [-np.sin(lam), np.cos(lam), 0.0]
    north = [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)]
    up = [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)]
    return np.array([east, north, up]) @ (earth_centred(*place) - earth_centred(*origin))


def one_pose() -> PoseGraph:
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=[1e-3] * 3 + [1e4] * 3)
    return graph


@pytest.mark.parametrize("place", PLACES)
def test_the_position_of_a_fix_equals_the_closed_form(place):
    graph = one_pose()
    graph.set_origin(*ORIGIN)
    number = graph.add_gps_geodetic(0, *place, sigmas=[1.0, 2.0, 3.0], lever_arm_m=[0.5, 0.0, 1.0], robust="huber")
    factor = graph.factors[number]
    np.testing.assert_allclose(factor.measured[:3], east_north_up(place, ORIGIN), atol=1e-6)
    np.testing.assert_array_equal(factor.measured[3:], [0.5, 0.0, 1.0])
    assert factor.noise.values.tolist() == [1.0, 2.0, 3.0]
    assert factor.robust.kernel == "huber"


def test_the_first_fix_is_the_origin_and_remains_it():
    graph = one_pose()
    first = graph.add_gps_geodetic(0, *PLACES[0], sigmas=1.0)
    assert graph.origin == PLACES[0]
    np.testing.assert_allclose(graph.factors[first].measured, 0, atol=1e-8)
    graph.remove(first)
    later = graph.add_gps_geodetic(0, *PLACES[1], sigmas=1.0)
    np.testing.assert_allclose(graph.factors[later].measured[:3], east_north_up(PLACES[1], graph.origin), atol=1e-6)
    graph.set_origin(*PLACES[0])  # setting the same origin again is allowed
    with pytest.raises(GraphError, match=r"origin at \(49\.02, 8\.43, 130\.0\); it cannot move"):
        graph.set_origin(*ORIGIN)
    assert graph.origin == PLACES[0]


def test_longitudes_from_zero_to_360_are_accepted():
    west, east = one_pose(), one_pose()
    for graph, longitude in ((west, -0.001), (east, 359.999)):
        graph.set_origin(51.5, 0.0, 0.0)
        graph.add_gps_geodetic(0, 51.5, longitude, 0.0, sigmas=1.0)
    np.testing.assert_allclose(west.factors[1].measured, east.factors[1].measured, atol=1e-6)


def test_geodetic_fixes_place_a_drive_and_convert_back(rng):
    """The antenna is off the body's origin; the solved poses convert back to the fixes' latitudes and longitudes."""
    lever = np.array([0.4, -0.2, 1.1])
    truth = [se3.exp([0, 0, 2.0, 250, -80, 12])]
    for _ in range(19):
        truth.append(truth[-1] @ se3.exp([0.01, 0.0, 0.1, 5.0, 0, 0]))
    antennas = np.array([se3.transform(T, lever[None])[0] for T in truth])
    places = geodetic_from_enu(antennas + 0.01 * rng.standard_normal((20, 3)), ORIGIN)
    graph = PoseGraph()
    graph.add_pose(0)
    graph.set_origin(*ORIGIN)
    for k in range(19):
        graph.add_between(k, k + 1, se3.between(truth[k], truth[k + 1]), sigmas=1e-3)
    for k, place in enumerate(places):
        graph.add_gps_geodetic(k, *place, sigmas=0.01, lever_arm_m=lever)
    solution = graph.optimize()
    np.testing.assert_allclose(solution.poses[:, :3, 3], np.array(truth)[:, :3, 3], atol=0.05)
    found = geodetic_from_enu([se3.transform(T, lever[None])[0] for T in solution.poses], graph.origin)
    assert (np.abs(found - places) < [1e-6, 1e-6, 0.1]).all()


def test_files_and_copies_keep_the_origin_to_the_last_bit(tmp_path):
    graph = one_pose()
    graph.add_gps_geodetic(0, 49.0 + 1 / 3, 8.0 + 1 / 7, 110.1, sigmas=1.0)
    graph.add_gps_geodetic(0, *PLACES[0], covariance=np.diag([1.0, 2.0, 3.0]))
    for solution in (None, graph.optimize()):
        graph.save(tmp_path / "graph.npz", solution)
        back = PoseGraph.load(tmp_path / "graph.npz")
        assert back.origin == graph.origin == GeodeticPoint(49.0 + 1 / 3, 8.0 + 1 / 7, 110.1)
        for number, factor in graph.factors.items():
            np.testing.assert_array_equal(back.factors[number].measured, factor.measured)
    assert graph._data.copy().origin == graph.origin
    with pytest.raises(GraphError, match="cannot move"):
        back.set_origin(*ORIGIN)
    one_pose().save(tmp_path / "none.npz")
    assert PoseGraph.load(tmp_path / "none.npz").origin is None


@pytest.mark.parametrize("origin", [[95.0, 8.0, 0.0], [49.0, 8.0], [np.nan, 8.0, 0.0], 7.0])
def test_a_file_with_an_invalid_origin_is_refused(tmp_path, origin):
    one_pose().save(tmp_path / "graph.npz")
    with np.load(tmp_path / "graph.npz") as archive:
        arrays = dict(archive)
    np.savez(tmp_path / "graph.npz", **arrays, origin=np.array(origin))
    with pytest.raises(DataError, match=r"graph\.npz.*damaged"):
        PoseGraph.load(tmp_path / "graph.npz")


def test_a_planar_graph_refuses_an_origin_and_geodetic_fixes():
    graph = PoseGraph(dimension=2)
    graph.add_prior(0, np.eye(4), sigmas=1.0)
    for call in (lambda: graph.set_origin(*ORIGIN), lambda: graph.add_gps_geodetic(0, *ORIGIN, sigmas=1.0)):
        with pytest.raises(GraphError, match="planar"):
            call()
    assert graph.origin is None
    assert len(graph.factors) == 1
