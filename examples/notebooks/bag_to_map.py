# %% [markdown]
# # From a bag to a map
#
# `ride` is a bag: of ROS 1 or ROS 2, or an MCAP file. Put the path of yours in its place.

# %%
import hybridlio as hl

bag = "ride"
sequence = hl.check_recording(hl.open_sequence(bag))  # clocks, units and mounting of the IMU, from the data
print(sequence)

# %% [markdown]
# Odometry goes through the bag once. Smoothing then uses all scans for each pose.

# %%
odometry = hl.Odometry()
for frame in sequence:
    estimate = odometry.step(frame)
smoothed = hl.smooth(odometry.record())
print(f"{smoothed.trajectory.length_m:.1f} m")

# %% [markdown]
# The map is one cloud without moving objects. CloudCompare opens the file; `.laz` works too, with `hybridlio[map]`.

# %%
from hybridlio.mapping.files import write_map

points = hl.build_map(sequence, smoothed.trajectory)
write_map("map.ply", points, colour="height")
print(points)
