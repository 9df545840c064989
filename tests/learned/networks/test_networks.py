from dataclasses import replace

import numpy as np
import pytest
import torch

from hybridlio.cloud.map_geometry import MapGeometry
from hybridlio.core import se3 as reference
from hybridlio.core.errors import ConfigError, DataError
from hybridlio.core.sensors import ImuSamples
from hybridlio.learned.data.imu_rows import imu_rows
from hybridlio.learned.networks import torch_se3 as se3
from hybridlio.learned.networks.attention import Attention, Mlp
from hybridlio.learned.networks.imu_network import ImuNetwork
from hybridlio.learned.networks.layers import CircularConv
from hybridlio.learned.networks.network_types import NetworkInput
from hybridlio.learned.networks.odometry_network import OdometryNetwork, parameter_count
from hybridlio.learned.networks.residual_network import Encoder
from hybridlio.learned.settings import NetworkSettings

TINY = NetworkSettings(
    geometry=MapGeometry(15.0, -25.0, 12, 40), imu_hidden=8, imu_layers=1, stem=8, stages=(8, 16), blocks=1, features=16
)


def given(settings: NetworkSettings = TINY, batch: int = 3) -> NetworkInput:
    generator = torch.Generator().manual_seed(4)
    shape = (batch, 3, settings.geometry.rows, settings.geometry.columns)
    ranges = 5 + 5 * torch.rand(shape[0], 1, *shape[2:], generator=generator)
    elevation = torch.deg2rad(14.0 - 38.0 * torch.arange(shape[2]) / (shape[2] - 1))[:, None]
    azimuth = torch.deg2rad(176.0 - 9.0 * torch.arange(shape[3]))[None]
    rays = [
        elevation.cos() * azimuth.cos(),
        elevation.cos() * azimuth.sin(),
        elevation.sin() * torch.ones_like(azimuth),
    ]
    vertices = ranges * torch.stack(rays)
    imu = torch.randn(batch, settings.imu_samples, 6, generator=generator)
    dt, v = torch.full((batch,), 0.1), torch.randn(batch, 3, generator=generator)
    return NetworkInput(vertices, vertices.flip(0), imu, dt, v, se3.identity(batch, vertices))


def network(**changes: object) -> OdometryNetwork:
    torch.manual_seed(0)
    return OdometryNetwork(replace(TINY, **changes))


def test_the_gate_is_the_papers_formula():
    gate, x = Attention(5), torch.randn(2, 5)
    i, o = torch.sigmoid(gate.input_gate(x)), torch.sigmoid(gate.output_gate(x))
    assert torch.equal(gate(x), o * torch.tanh(i * torch.tanh(gate.candidate(x))))


def test_the_alternative_is_two_layers_of_tanh():
    mlp, x = Mlp(5), torch.randn(2, 5)
    assert torch.equal(mlp(x), torch.tanh(mlp.second(torch.tanh(mlp.first(x)))))


def samples(times_s: list[float]) -> ImuSamples:
    t = np.array(times_s)
    ramp = np.outer(t, [1.0, 2.0, 3.0])
    return ImuSamples((t * 1e9).astype(np.int64), ramp, ramp + np.array([0.0, 0.0, 9.81]))


@pytest.mark.parametrize("times", [[0.0, 0.1], [0.0, 0.03, 0.1], list(np.linspace(0, 0.1, 40))])
def test_runs_of_any_length_are_resampled_evenly(times):
    rows = imu_rows(samples(times), 15)
    assert rows.shape == (15, 6)
    assert np.allclose(rows[:, 0], np.linspace(0, 0.1, 15), atol=1e-6)
    assert np.allclose(rows[:, 5], 9.81 + 3 * np.linspace(0, 0.1, 15), atol=1e-5)


def test_a_single_sample_is_repeated_and_none_is_an_error():
    assert np.ptp(imu_rows(samples([0.1]), 15), axis=0).tolist() == [0.0] * 6
    with pytest.raises(DataError, match="IMU"):
        imu_rows(ImuSamples.empty(), 15)


def test_rows_are_turned_into_the_lidars_axes():
    T_imu_lidar = reference.exp([0.2, -0.4, 1.0, 1.0, 2.0, 3.0])
    rows, turned = imu_rows(samples([0.0, 0.1]), 4), imu_rows(samples([0.0, 0.1]), 4, T_imu_lidar)
    R_lidar_imu = T_imu_lidar[:3, :3].T
    assert np.allclose(turned[3, 3:], R_lidar_imu @ rows[3, 3:], atol=1e-5)
    assert np.allclose(turned[3, :3], R_lidar_imu @ rows[3, :3], atol=1e-5)


def test_translation_depends_on_acceleration_alone_and_rotation_on_angular_velocity_alone():
    net = ImuNetwork(TINY)
    imu = given().imu
    other_gyro, other_accel = imu.clone(), imu.clone()
    other_gyro[..., :3] += 1.0
    other_accel[..., 3:] += 1.0
    T, by_gyro, by_accel = net(imu), net(other_gyro), net(other_accel)
    assert torch.equal(T[:, :3, 3], by_gyro[:, :3, 3])
    assert not torch.allclose(T[:, :3, :3], by_gyro[:, :3, :3])
    assert torch.equal(T[:, :3, :3], by_accel[:, :3, :3])
    assert not torch.allclose(T[:, :3, 3], by_accel[:, :3, 3])


def test_a_velocity_translates_the_initial_pose_by_velocity_times_duration():
    net = ImuNetwork(replace(TINY, velocity=True, siamese="twins"))
    torch.nn.init.zeros_(net.translation.weight)
    torch.nn.init.zeros_(net.translation.bias)
    x = given()
    assert torch.allclose(net(x.imu, x.velocity_m_s, x.dt_s)[:, :3, 3], 0.1 * x.velocity_m_s)


def test_a_constant_rate_rotates_the_initial_pose_by_rate_times_duration():
    net = ImuNetwork(replace(TINY, mean_rate=True, rotation="log"))
    torch.nn.init.zeros_(net.rotation.weight)
    rate, dt = torch.tensor([[0.1, -0.2, 0.5], [0.0, 0.0, -0.3]]), torch.tensor([0.1, 0.2])
    imu = torch.cat([rate, torch.zeros(2, 3)], dim=1)[:, None].expand(-1, 15, -1)
    assert torch.allclose(net(imu, None, dt)[:, :3, :3], se3.so3_exp(rate * dt[:, None]), atol=1e-6)


def test_an_initial_pose_is_perturbed_for_refinement_only():
    net, x = network().eval(), given()
    shake = se3.exp(torch.tensor([[0.0, 0.0, 0.01, 0.1, 0.0, 0.0]])).expand(3, 4, 4)
    plain, shaken = net(x), net(replace(x, perturbation=shake))
    assert torch.equal(shaken.initial, plain.initial)
    assert torch.allclose(shaken.pose, net.refine(x, plain.initial @ shake).pose, atol=1e-6)


def test_siamese_lstms_and_encoders_share_their_weights_and_twins_do_not():
    shared, twins = network(), network(siamese="twins")
    assert shared.imu_network.gyro_lstm is shared.imu_network.accel_lstm
    vertices, normals = shared.residual_network.vertex_encoder, shared.residual_network.normal_encoder
    assert normals.stem.conv is vertices.stem.conv
    assert normals.full is vertices.full
    assert normals.stages[0].first_norm is not vertices.stages[0].first_norm
    assert twins.imu_network.gyro_lstm is not twins.imu_network.accel_lstm
    assert parameter_count(twins) > parameter_count(shared)


@pytest.mark.parametrize("normalisation", ["batch", "group", "none"])
@pytest.mark.parametrize("siamese", ["shared", "twins"])
def test_evaluation_gives_the_features_of_training(siamese, normalisation):
    net, x = network(siamese=siamese, normalisation=normalisation, vertex_scale_m=1.0), given(batch=8)
    residual = net.residual_network
    with torch.no_grad():
        for _ in range(60):  # running statistics decay by a tenth each time
            trained = _branch_features(residual, net, x)
        evaluated = _branch_features(residual.eval(), net, x)
    for a, b in zip(trained, evaluated, strict=True):
        assert (a - b).norm() < 0.1 * a.norm()  # with one normalisation for both kinds of map it is 0.5 and more


def _branch_features(residual, net, x):
    last, current = net.encode(x.last), net.encode(x.current)
    pairs = [torch.cat(both, dim=1) for both in ((last.vertices, current.vertices), (last.normals, current.normals))]
    return residual.vertex_encoder(pairs[0]), residual.normal_encoder(pairs[1])


def test_initial_poses_start_near_the_identity():
    x = given(batch=8)
    for siamese in ("shared", "twins"):
        moved = se3.log(network(siamese=siamese).imu_network(x.imu))
        assert moved.norm(dim=1).median() < 0.05  # 0.3 with default initialisation of the last layers


def test_features_do_not_depend_on_where_the_map_is_cut():
    encoder = Encoder(6, TINY).eval()
    x = torch.randn(2, 6, 12, 40)
    # 8 columns: as many as the strides of stem and stages take together
    assert torch.allclose(encoder(x), encoder(x.roll(8, dims=-1)), atol=1e-5)


def test_convolutions_wrap_around_columns_but_not_rows():
    conv, x = CircularConv(1, 1, 3, (1, 1)), torch.zeros(1, 1, 5, 6)
    torch.nn.init.ones_(conv.conv.weight)
    x[0, 0, 0, 0] = 1.0
    assert conv(x)[0, 0].nonzero().tolist() == [[0, 0], [0, 1], [0, 5], [1, 0], [1, 1], [1, 5]]


def test_the_pose_is_the_residual_times_the_initial_pose():
    out = network().eval()(given())
    assert torch.allclose(out.residual @ out.initial, out.pose, atol=1e-5)
    assert not torch.allclose(out.initial, out.pose, atol=1e-4)


ROWS = [
    {"imu": imu, "normals": normals, "head": head}
    for imu in ("initial-pose", "feature", "none", "given")
    for normals in ("separate", "joined", "none")
    for head in ("attention", "mlp")
]
MORE = [
    {"siamese": "twins", "velocity": True, "distance": "distance"},
    {"siamese": "shared", "velocity": True, "distance": "gradient", "normalisation": "group"},
    {"projective_steps": 2, "iterations": 2},
    {"projective_steps": 2, "encoder": False, "weight_channels": 0},
    {"siamese": "twins", "velocity": True, "mean_rate": True, "rotation": "log", "stem_stride": (2, 4)},
    {"normalisation": "none", "siamese": "twins", "distance": "gradient"},
    {"rotation": "log", "iterations": 3, "normalisation": "group", "pooled_columns": 4},
]


@pytest.mark.parametrize("changes", ROWS + MORE, ids=str)
def test_every_variant_gives_poses_and_a_gradient_to_every_weight(changes):
    net = network(**changes)
    out = net(given())
    settings = net.settings
    assert len(out.poses) == settings.iterations * (settings.projective_steps + settings.encoder)
    R = out.pose[:, :3, :3]
    assert torch.allclose(R @ R.transpose(1, 2), torch.eye(3).expand(3, 3, 3), atol=1e-5)
    # steps detach their input pose: each is trained by its own output only
    taught = [out.initial, *out.poses] if settings.projective_steps else [out.pose]
    torch.stack(taught).square().sum().backward()
    missing = [name for name, p in net.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
    assert missing == []


def test_translation_ignores_normals_with_separate_branches():
    x = given()
    for normals, sees in (("separate", False), ("joined", True)):
        net = network(normals=normals, imu="none").eval()
        before = net(x).pose
        net.residual_network.normal_encoder = _Shifted(net.residual_network.normal_encoder)
        after = net(x).pose
        assert torch.equal(before[:, :3, 3], after[:, :3, 3]) != sees
        assert not torch.allclose(before[:, :3, :3], after[:, :3, :3], atol=1e-7)


class _Shifted(torch.nn.Module):
    def __init__(self, inner: torch.nn.Module) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.inner(x) + 1.0


def test_maps_of_other_cells_and_a_missing_initial_pose_are_refused():
    x = given()
    with pytest.raises(ConfigError, match="12 x 40"):
        network()(replace(x, last=x.last[..., :20]))
    with pytest.raises(ConfigError, match="initial pose"):
        network(imu="given")(replace(x, initial=None))
