"""Training needs only torch and numpy."""

import subprocess
import sys

BLOCKED = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in "scipy pinocchio coal ompl numba rerun cvxpy matplotlib".split():
            raise ImportError(f"{name} is not on a bare machine")
sys.meta_path.insert(0, Blocked())
from cli.main import main
sys.exit(main(["train", "stage1", "--profile", "smoke", "--print-config"]))
"""


def test_the_train_command_starts_with_torch_and_numpy_alone():
    done = subprocess.run([sys.executable, "-c", BLOCKED], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert '"name": "smoke"' in done.stdout
