"""Nested state as named tensors and JSON, bit for bit and without pickle.

An optimizer's or module's ``state_dict`` is a tree of dicts, lists and tuples with tensors, numbers and
text at its leaves. ``flatten_state`` takes the tensors out under readable names and describes the rest in
JSON; where JSON knows no such thing (tuples, integer keys, infinities, the place of a tensor) a dict with
one key that begins with ``$`` stands for it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor


def flatten_state(state: Any) -> tuple[dict[str, Tensor], Any]:
    """Split nested state into tensors and a JSON-able tree.

    Tensors are detached, on the CPU and contiguous; those that are so already share their memory with the state, so
    use the result before training goes on. Python and NumPy numbers, text, ``None``, dicts with text or integer
    keys, lists, tuples and NumPy arrays are kept; NumPy scalars become Python numbers.

    Args:
        state: the nested state. Of a ``torch.Generator`` pass ``get_state()``, which is a tensor.

    Returns:
        The tensors by dotted name, and the tree that names them.

    Raises:
        TypeError: if the state holds anything else; names where.

    Example:
        >>> tensors, tree = flatten_state({"step": torch.ones(2), "betas": (0.9, 0.99)})
        >>> list(tensors), tree
        (['step'], {'step': {'$tensor': 'step'}, 'betas': {'$tuple': [0.9, 0.99]}})
    """
    tensors: dict[str, Tensor] = {}
    return tensors, _flatten(state, "", tensors)


def unflatten_state(tensors: Mapping[str, Tensor], tree: Any) -> Any:
    """The nested state of which ``flatten_state`` made these tensors and this tree.

    Raises:
        ValueError: if the tree names a tensor that is not there, or holds an unknown mark.
    """
    if isinstance(tree, list):
        return [unflatten_state(tensors, inner) for inner in tree]
    if not isinstance(tree, dict):
        return tree
    mark = next(iter(tree), "")
    if len(tree) != 1 or not mark.startswith("$"):
        return {key: unflatten_state(tensors, inner) for key, inner in tree.items()}
    value = tree[mark]
    if mark in ("$tensor", "$array"):
        if value not in tensors:
            raise ValueError(f"tensor {value!r} is missing")
        return tensors[value] if mark == "$tensor" else tensors[value].numpy()
    if mark == "$tuple":
        return tuple(unflatten_state(tensors, inner) for inner in value)
    if mark == "$items":
        return {key: unflatten_state(tensors, inner) for key, inner in value}
    if mark == "$float":
        return float(value)
    raise ValueError(f"unknown mark {mark!r}")


def _flatten(value: Any, path: str, tensors: dict[str, Tensor]) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        # A finite float in JSON is its shortest exact decimal, which reads back to the same bits.
        return float(value) if math.isfinite(value) else {"$float": str(float(value))}
    if isinstance(value, Tensor):
        return {"$tensor": _store(value, path, tensors)}
    if isinstance(value, np.ndarray) and value.dtype != object:
        return {"$array": _store(torch.from_numpy(np.array(value, order="C")), path, tensors)}
    if isinstance(value, (list, tuple)):
        items = [_flatten(inner, _join(path, i), tensors) for i, inner in enumerate(value)]
        return items if isinstance(value, list) else {"$tuple": items}
    if isinstance(value, Mapping) and all(type(key) in (str, int) for key in value):
        pairs = [(key, _flatten(inner, _join(path, key), tensors)) for key, inner in value.items()]
        if all(isinstance(key, str) and not key.startswith("$") for key in value):
            return dict(pairs)
        return {"$items": [list(pair) for pair in pairs]}
    raise TypeError(f"state: {path or 'it'} is {type(value).__name__}, which a checkpoint does not hold")


def _store(tensor: Tensor, path: str, tensors: dict[str, Tensor]) -> str:
    name, number = path or "value", 2
    # Different paths may read the same once joined by dots.
    while name in tensors:
        name, number = f"{path}~{number}", number + 1
    plain = tensor.detach().cpu().contiguous()
    # One memory for two names, or a part of a larger one, is not what a file of tensors holds.
    shared = plain.untyped_storage().nbytes() != plain.nbytes or any(
        plain.data_ptr() == other.data_ptr() for other in tensors.values() if other.numel()
    )
    tensors[name] = plain.clone() if shared else plain
    return name


def _join(path: str, key: object) -> str:
    return f"{path}.{key}" if path else str(key)
