# %% [markdown]
# # Localise in a map
#
# The run of a first drive is a map. The second drive goes through the same town, with other traffic and parked cars.

# %%
import subprocess
import sys
from pathlib import Path

import hybridlio as hl

town = {"seconds": 3, "seed": 7, "lidar": "16-beam"}
first = hl.simulate(Path("drives"), hl.SimulationConfig(**town))
second = hl.simulate(Path("second"), hl.SimulationConfig(**town, drive_seed=8))
subprocess.run([sys.executable, "-m", "hybridlio", "odometry", first, "-o", "run", "--overwrite"], check=True)

# %% [markdown]
# Without `start` the place is recognised, which takes a map of more than a few metres.

# %%
found = hl.localize(hl.open_sequence(second), "run", start=(0.0, 0.0, 0.0))  # x, y [m] and yaw [rad] in the map
print(f"the map held {100 * found.held.mean():.0f} % of the scans")
print("σ of the last position [m]:", found.trajectory.covariances[-1].diagonal()[3:] ** 0.5)

# %% [markdown]
# [Localise in a map](../how_to/localization.md) says what happens where the map ends.
