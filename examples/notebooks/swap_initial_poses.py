# %% [markdown]
# # Swap initial poses
#
# An initial pose predicts each step before the scans are looked at. Everything else stays the same.

# %%
import numpy as np

import hybridlio as hl
from hybridlio.core import se3

sequence = hl.open_sequence(hl.simulate("drives", hl.SimulationConfig(seconds=1.2, seed=7, lidar="16-beam")))
true_steps = se3.between(sequence.reference.poses[:-1], sequence.reference.poses[1:])

# %% [markdown]
# `lstm` is the network's own, with the shipped weights. The speed is unknown at the first step, which is left out.

# %%
for name in ("preintegration", "lstm", "kalman", "constant-velocity"):
    odometry = hl.Odometry(initial_pose=name)
    estimates = [odometry.step(frame) for frame in sequence]
    initial = np.array([estimate.initial.pose for estimate in estimates[1:]])
    error_m = np.linalg.norm(se3.log(se3.between(true_steps, initial))[1:, 3:], axis=1)
    print(f"{name}: initial poses {100 * error_m.mean():.1f} cm off on average")

# %% [markdown]
# An object with `name`, `predict` and `correct` is a source, too: `examples/own_initial_pose_source.py`.
