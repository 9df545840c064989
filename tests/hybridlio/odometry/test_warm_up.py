import subprocess
import sys

import pytest

SCRIPT = """
import sys
from hybridlio.odometry.warm_up import made_up_frame, warm_up
from hybridlio import Odometry

odometry = Odometry(initial_pose={initial_pose!r}, keep_record=False)
warm_up(odometry)
before = set(sys.modules)
compiled = [m for name, m in sys.modules.items() if name.startswith("hybridlio") and hasattr(m, "compiled")]
kernels = [f for m in compiled for f in vars(m).values() if hasattr(f, "signatures")]
signatures = [len(f.signatures) for f in kernels]
for index in range(10, 14):
    odometry.step(made_up_frame(index, {with_imu}))
loaded = set(sys.modules) - before
assert kernels and [len(f.signatures) for f in kernels] == signatures, "compiled after the warm-up"
assert not [name for name in loaded if name.split(".")[0] in ("gtsam", "numba", "scipy", "small_gicp")], loaded
"""


@pytest.mark.parametrize(("with_imu", "initial_pose"), [(True, None), (False, "constant-velocity")])
def test_after_the_warm_up_the_first_scans_load_and_compile_nothing(with_imu, initial_pose):
    script = SCRIPT.format(with_imu=with_imu, initial_pose=initial_pose)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
