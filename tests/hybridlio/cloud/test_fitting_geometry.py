"""Cells that fit a lidar are found from one of its scans: a row for each beam."""

from dataclasses import replace

import numpy as np
import pytest

from hybridlio.cloud.fitting_geometry import fitting_geometry
from hybridlio.cloud.map_geometry import MAP_GEOMETRIES
from hybridlio.cloud.projection import normal_map, vertex_map
from hybridlio.core.lidar_models import LIDAR_MODELS


def in_a_sphere(elevations_deg, columns, radius_m=10.0):
    azimuths = np.radians(np.linspace(-180, 180, columns, endpoint=False))
    el, az = np.meshgrid(np.radians(elevations_deg), azimuths, indexing="ij")
    directions = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], axis=-1)
    return (radius_m * directions).reshape(-1, 3).astype(np.float32)


@pytest.mark.parametrize("beams", [16, 32, 64])
@pytest.mark.parametrize("span_deg", [30.0, 90.0])
def test_evenly_spaced_beams_get_a_row_each(beams, span_deg):
    elevations = np.linspace(-span_deg / 2, span_deg / 2, beams)
    cells = fitting_geometry(in_a_sphere(elevations, 1800))
    assert (cells.rows, cells.columns) == (beams, 720)
    spacing = span_deg / (beams - 1)
    assert cells.row_deg == pytest.approx(spacing, rel=0.02)
    assert cells.fov_up_deg == pytest.approx(span_deg / 2 + spacing / 2, abs=0.1 * spacing)


def test_the_sixteen_beams_of_the_preset_get_the_presets_cells():
    model = LIDAR_MODELS["16-beam"]
    found, preset = fitting_geometry(in_a_sphere(model.elevations_deg, model.columns)), MAP_GEOMETRIES["16-beam"]
    assert (found.rows, found.columns) == (preset.rows, preset.columns)
    assert found.fov_up_deg == pytest.approx(preset.fov_up_deg, abs=0.1)


def test_few_columns_get_wide_cells_and_stray_returns_do_not_widen_the_rows():
    points = in_a_sphere(np.linspace(-15, 15, 16), 360)
    assert fitting_geometry(points).columns == 360
    stray = np.array([[0.1, 0.0, 5.0]] * 5, np.float32)
    assert fitting_geometry(np.r_[points, stray]).fov_up_deg < 17


def test_no_other_tried_number_of_rows_has_more_normals():
    points = in_a_sphere(np.linspace(-20, 20, 40), 1024)
    cells = fitting_geometry(points)
    for rows in (20, 32, 64):
        other = replace(cells, rows=rows)
        fewer = normal_map(vertex_map(points, other)).any(axis=0).sum()
        assert fewer <= normal_map(vertex_map(points, cells)).any(axis=0).sum()


def test_scans_without_a_grid_have_no_cells():
    assert fitting_geometry(np.zeros((5, 3), np.float32)) is None
    assert fitting_geometry(np.array([[1.0, 0, 0]], np.float32)) is None
