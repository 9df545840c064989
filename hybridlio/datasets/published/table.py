"""The published data sets that have a layout of their own, by the names of their readers."""

from __future__ import annotations

from hybridlio.datasets.published import (
    apollo,
    argoverse2,
    boreas,
    helipr,
    kitti360,
    mulran,
    nclt,
    newer_college,
    nuscenes,
    tum_rgbd,
)
from hybridlio.datasets.published.recording import Layout

PUBLISHED: dict[str, Layout] = {
    "kitti-360": kitti360.LAYOUT,
    "nuscenes": nuscenes.LAYOUT,
    "nclt": nclt.LAYOUT,
    "mulran": mulran.LAYOUT,
    "helipr": helipr.LAYOUT,
    "boreas": boreas.LAYOUT,
    "newer-college": newer_college.LAYOUT,
    "argoverse-2": argoverse2.LAYOUT,
    "apollo": apollo.LAYOUT,
    "tum-rgbd": tum_rgbd.LAYOUT,
}
