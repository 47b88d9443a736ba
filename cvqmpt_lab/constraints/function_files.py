"""Constraints of the user's own by address, in problem files and on the command line.

A file alone never runs code: it may name a function where `base.modules.allow_code` was called.
"""

import inspect
from collections.abc import Iterable, Mapping
from importlib import metadata
from typing import Any

from cvqmpt_lab.base.errors import InvalidInputError, UnknownChoiceError, at, mapping, shown
from cvqmpt_lab.base.files import json_object
from cvqmpt_lab.base.modules import described, imported, require_code_allowed
from cvqmpt_lab.constraints.function import FunctionConstraint


def function_of(value: Mapping[str, Any], where: str) -> FunctionConstraint:
    """Return the constraint of json {"function": "module:name", ...fields}."""
    fields = {name: part for name, part in mapping(value, where).items() if name != "_comment"}
    address = fields.pop("function")
    if not isinstance(address, str):
        raise InvalidInputError(f"{at(where, 'function')} is {shown(address)}; write 'my_module:F'")
    require_code_allowed(f"{where} names code, {address!r}, which would run")
    return load_function(address, fields)


def function_given(text: str) -> FunctionConstraint:
    """Return the constraint of --constraint: module:F, or json {"function": "module:F", ...}.

    A user who writes it on the command line allows it to run.
    """
    if not text.lstrip().startswith("{"):
        return load_function(text)
    fields = json_object(text, "--constraint")
    address = fields.pop("function")
    if not isinstance(address, str):
        raise InvalidInputError(f"--constraint: function is {shown(address)}; write 'my_module:F'")
    return load_function(address, fields)


def load_function(
    address: str, fields: Mapping[str, Any] | None = None, group: str = "cvqmpt.constraints"
) -> FunctionConstraint:
    """Return a constraint by its address.

    Args:
        address: ``module:name`` of a FunctionConstraint, or of a function that returns one; or the
            name of an entry point of an installed distribution.
        fields: arguments of that function. Bounds lower and upper that it does not take, and those
            of a FunctionConstraint, replace the bounds of what it returns.
        group: of the entry points.
    """
    fields, given, what = dict(fields or {}), address, f"constraint {address}"
    source = address, dict(fields)
    if ":" not in address:
        entries = {entry.name: entry.value for entry in metadata.entry_points(group=group)}
        if address not in entries:
            names = ", ".join(sorted(entries)) or "none is installed"
            raise InvalidInputError(
                f"{what}: write module:name, or the name of an entry point {group!r} ({names})"
            )
        given = entries[address]
    module_name, _, name = given.partition(":")
    module = imported(what, module_name)
    if not hasattr(module, name):
        own = [key for key in vars(module) if not key.startswith("_")]
        raise UnknownChoiceError(f"constraint of {module_name}", name, own)
    found = getattr(module, name)
    limits = {key: fields.pop(key) for key in ("lower", "upper") if key in fields}
    if _takes(found, limits):
        fields, limits = fields | limits, {}
    if callable(found) and not isinstance(found, FunctionConstraint):
        try:
            inspect.signature(found).bind(**fields)
        except (TypeError, ValueError) as error:
            raise InvalidInputError(
                f"{what}: {error}; it is called with the fields of the problem file: give a "
                "function F(q) as FunctionConstraint(k, F), k entries"
            ) from error
        try:
            found = found(**fields)
        except BaseException as error:
            raise InvalidInputError(f"{what}: making it raises {described(error)}") from error
    elif fields:
        raise InvalidInputError(
            f"{what} is no function, so it has no field {', '.join(fields)}: leave it out; fields "
            "of every constraint: lower, upper"
        )
    if not isinstance(found, FunctionConstraint):
        raise InvalidInputError(
            f"{what} is {shown(found)}: give a FunctionConstraint, or a function that returns one"
        )
    if limits:
        found = found.within(**limits)
    found.source, found.load = source, load_function
    return found


def _takes(function: Any, names: Iterable[str]) -> bool:
    """Return whether a function takes arguments of some names."""
    if isinstance(function, FunctionConstraint) or not callable(function):
        return False
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return True
    anything = any(one.kind is inspect.Parameter.VAR_KEYWORD for one in parameters)
    return anything or {*names} <= {one.name for one in parameters}
