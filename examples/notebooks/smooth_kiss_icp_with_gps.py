# %% [markdown]
# # Smooth the result of KISS-ICP with GPS
#
# `smooth` takes poses of any odometry. `kiss_poses_tum.txt` stands for the file that
# `kiss_icp_pipeline DATA` writes. So that this notebook runs without KISS-ICP, it holds the true poses
# with a growing turn.

# %%
import numpy as np

import hybridlio as hl
from hybridlio.core import se3
from hybridlio.core.trajectory import read_trajectory, write_tum

config = hl.SimulationConfig(seconds=8, seed=3, lidar="16-beam", gps=True)
sequence = hl.open_sequence(hl.simulate("drives", config))
turn = se3.exp(np.linspace(0, 1, len(sequence))[:, None] * [0, 0, 0.1, 0, 0, 0])
write_tum("kiss_poses_tum.txt", hl.Trajectory(sequence.stamps_ns, turn @ sequence.reference.poses))

# %% [markdown]
# The covariance of a step, rotation first, says how far the poses are trusted; with an IMU (`imu="imu.csv"`) it is
# estimated, and the clocks are compared. GPS fixes may also be a file, `gps="gps.csv"`.

# %%
poses = read_trajectory("kiss_poses_tum.txt")
step_covariance = np.diag([0.002, 0.002, 0.01, 0.02, 0.02, 0.02]) ** 2
smoothed = hl.smooth(
    "kiss_poses_tum.txt", gps=sequence.gps, calibration=sequence.calibration, covariances=step_covariance
)
print(smoothed.summary())

# %% [markdown]
# The poses before and after, aligned as a whole with the true ones:

# %%
for name, trajectory in (("KISS-ICP", poses), ("with GPS", smoothed.trajectory)):
    print(f"{name}: ATE {hl.evaluate(trajectory, sequence.reference).ate_m:.3f} m")
