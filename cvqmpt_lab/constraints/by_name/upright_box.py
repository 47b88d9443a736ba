"""Constraint `upright-box`, which `task_space_region` has, as others need it."""

from cvqmpt_lab.constraints.task_space_region import upright_box

__all__ = ["EXAMPLE", "upright_box"]
EXAMPLE = 0.1
