# %% [markdown]
# # A factor of your own
#
# A vehicle drives an eighth of a circle a step, and measures its distance to a mast.

# %%
import numpy as np

from hybridlio.core import se3
from hybridlio.graph import PoseGraph

T_k_k1 = se3.exp([0, 0, np.pi / 4, 1.0, 0, 0])  # rotation first: rad, then m
graph = PoseGraph()
graph.add_prior(0, np.eye(4), sigmas=(1e-3,) * 6)
for k in range(4):
    graph.add_between(k, k + 1, T_k_k1, sigmas=(0.01, 0.01, 0.01, 0.1, 0.1, 0.1))
before = graph.optimize()

# %% [markdown]
# The residual takes the pose and is zero where the measurement is met. GTSAM differentiates it numerically, unless a
# Jacobian is given, which is compared with the numeric one.

# %%
mast_m, measured_m = np.array([3.0, 4.0, 0.0]), 2.0


def residual(T):
    return np.linalg.norm(T[:3, 3] - mast_m) - measured_m


factor = graph.add_factor(4, residual, sigmas=0.05)
after = graph.optimize()
print(f"distance to the mast: {residual(before.pose(4)) + measured_m:.2f} m before, {measured_m} m measured")
print(f"residual {float(np.squeeze(after.residual(factor))):.3f} m after")
print("σ of the position [m]:", np.sqrt(np.diag(after.covariance(4))[3:]).round(3))

# %% [markdown]
# [Solve pose graphs](../how_to/pose_graphs.md) has the other factors, robust kernels and solvers.
