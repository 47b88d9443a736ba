"""Load an arm from its URDF and print its joints and their limits."""

from pathlib import Path

from cvqmpt_lab import load_robot

urdf = Path(__file__).parents[2] / "tests" / "data" / "slider_arm.urdf"
robot = load_robot(urdf, end_effector="tool")
print(robot)
for name, low, high in zip(robot.joint_names, robot.lower, robot.upper, strict=True):
    print(f"{name}: {low:.2f} to {high:.2f}")
