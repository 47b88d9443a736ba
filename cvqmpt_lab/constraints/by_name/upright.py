"""Constraint `upright`, which `task_space_region` has, as others need it."""

from cvqmpt_lab.constraints.task_space_region import upright

__all__ = ["EXAMPLE", "upright"]
EXAMPLE = 0.1
