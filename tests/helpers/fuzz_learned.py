"""Files of the learned front end, to be damaged: how each is written and read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from fuzz_input import Input

from hybridlio.cloud.map_geometry import map_geometry
from hybridlio.learned.data.pairs import Pairs
from hybridlio.learned.data.shards import ScanRecord, Shard, write_shard
from hybridlio.learned.networks.odometry_network import OdometryNetwork
from hybridlio.learned.networks.weights import load_weights, save_weights
from hybridlio.learned.settings import NetworkSettings, Recipe
from hybridlio.learned.training import checkpoints
from hybridlio.learned.training.training_log import read_log

_GEOMETRY = map_geometry("16-beam")
_SMALL = NetworkSettings(geometry=_GEOMETRY, stem=4, stages=(4,), blocks=1, features=4, imu_hidden=4, imu_layers=1)


def written_weights(root: Path) -> Path:
    root.mkdir(parents=True)
    recipe = Recipe(network=_SMALL)
    save_weights(root / "weights.safetensors", OdometryNetwork(_SMALL), recipe, {"about": "made up"})
    return root / "weights.safetensors"


def read_weights(path: Path) -> None:
    load_weights(path).network()


def written_checkpoint(root: Path) -> Path:
    root.mkdir(parents=True)
    recipe, network = Recipe(network=_SMALL), OdometryNetwork(_SMALL)
    optimiser = torch.optim.Adam(network.parameters())
    for parameter in network.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimiser.step()
    checkpoints.save(root / "checkpoint.pt", checkpoints.take(recipe, 10, 1, network, optimiser))
    return root / "checkpoint.pt"


def read_checkpoint(path: Path) -> None:
    found, network = checkpoints.load(path), OdometryNetwork(_SMALL)
    if found.recipe == Recipe(network=_SMALL):
        checkpoints.restore(found, network, torch.optim.Adam(network.parameters()))


def written_shard(root: Path) -> Path:
    rng, scans = np.random.default_rng(0), []
    cells = (3, _GEOMETRY.rows, _GEOMETRY.columns)
    imu, pose = np.ones((_SMALL.imu_samples, 6), np.float32), np.eye(4)
    for k in range(4):
        vertices, points = (rng.uniform(-9, 9, shape).astype(np.float32) for shape in (cells, (5, 3)))
        normals = np.tile(np.float32([0, 0, 1]), (5, 1))
        known = {"imu": imu, "initial": pose, "reference": pose} if k else {}
        scans.append(ScanRecord(vertices, points, normals, dt_s=0.1, **known))
    write_shard(root / "shard", scans, "made up", _GEOMETRY, _SMALL.imu_samples)
    return root / "shard"


def read_shard(folder: Path) -> None:
    pairs = Pairs([Shard(folder)], _SMALL)
    pairs.batch(range(len(pairs)))


def written_log(root: Path) -> Path:
    root.mkdir(parents=True)
    (root / "log.jsonl").write_text('{"step": 1, "loss": 0.5}\n{"step": 2, "loss": 0.4}\n')
    return root / "log.jsonl"


LEARNED = {
    "weights": Input(written_weights, read_weights),
    "checkpoint": Input(written_checkpoint, read_checkpoint),
    "shard": Input(written_shard, read_shard),
    "training-log": Input(written_log, read_log),
}
