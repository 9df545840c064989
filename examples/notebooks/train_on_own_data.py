# %% [markdown]
# # Train on your own data
#
# Training needs recordings alone, no poses. Here a short simulated drive and a few steps stand in for hours of both.

# %%
import subprocess
import sys
from pathlib import Path

import hybridlio as hl

drive = hl.simulate("drives", hl.SimulationConfig(seconds=2, seed=7, lidar="16-beam"))
small = """
network: {geometry: 16-beam, projective_steps: 2, imu_hidden: 8, imu_layers: 1, stem: 8, stages: [8], blocks: 1}
optimiser: {batch: 4}
"""
Path("small.yaml").write_text(small)


def hybridlio(*words):
    subprocess.run([sys.executable, "-m", "hybridlio", *map(str, words)], check=True)


# %% [markdown]
# `--init-from shipped` adapts the shipped weights instead. The same command goes on after an interruption.

# %%
hybridlio("train", drive, "--steps", 3, "-o", "training", "--config", "small.yaml")

# %% [markdown]
# The weights replace the shipped ones, from Python or by `hybridlio odometry --config`.

# %%
config = hl.Config.model_validate({"residual": "network", "network": {"weights": "training/weights.safetensors"}})
odometry = hl.Odometry(config=config)
estimates = [odometry.step(frame) for frame in hl.open_sequence(drive)]
print(f"{len(estimates)} scans by the new weights")
