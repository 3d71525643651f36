"""The choice between the plain PyTorch version of an operation and a compiled one.

An operation is a function in plain PyTorch, for any device and float dtype, with its documentation and argument checks.
A compiled version registers itself, and whoever calls the operation does not know which of them ran::

    @operation(check=_check_double)
    def double(x: Tensor) -> Tensor: ...          # gridreg/ops/double.py

    @double.register_cpu()
    def _double(x: Tensor) -> Tensor: ...         # gridreg/ops/cpu/double.py, imported by `gridreg.ops`

`torch.library.custom_op` would do the same for 0.1 to 0.3 ms more a call, and chooses by device alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import TracebackType
from typing import Generic, ParamSpec, TypeVar

import torch
from torch import Tensor

from gridreg.errors import InputError

_P = ParamSpec("_P")
_R = TypeVar("_R")
_CHOICES = ("auto", "compiled", "torch")
_choice = "auto"
_compiled: set[str] = set()


def chosen_backend() -> str:
    """The name given to the last `use_backend` that is still in force: "auto" by default."""
    return _choice


class use_backend:
    """Choose the version of all operations, for good or for the length of a ``with`` block.

    The choice holds for the whole process: a viewer's thread follows the trainer's.

    Args:
        name: "torch" forces the plain versions; "compiled" and "auto" take the compiled ones for CPU float32
            tensors and the plain ones for all others, "auto" also where nothing is compiled (without numba).

    Raises:
        InputError: for an unknown name, or for "compiled" where nothing is.

    Example:
        >>> with use_backend("torch"):
        ...     chosen_backend()
        'torch'
        >>> chosen_backend()
        'auto'
    """

    def __init__(self, name: str) -> None:
        global _choice
        if name not in _CHOICES:
            raise InputError(f"backend: found {name!r}, expected one of {', '.join(_CHOICES)}")
        if name == "compiled" and not _compiled:
            raise InputError(
                "backend 'compiled': numba is not installed, expected it (`pip install gridreg[train]`)"
            )
        self._previous = _choice
        _choice = name

    def __enter__(self) -> use_backend:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        global _choice
        _choice = self._previous


def is_cpu_float32(*arguments: object, **named: object) -> bool:
    """Whether all tensors among the arguments, in tuples and lists too, suit compiled code.

    They lie on the CPU, real numbers are float32, and elements can be counted in 32 bits.

    Example:
        >>> is_cpu_float32(torch.zeros(1), [torch.zeros(1, dtype=torch.int64)], 0.5)
        True
        >>> is_cpu_float32((torch.zeros(1, dtype=torch.float64),))
        False
    """
    for value in (*arguments, *named.values()):
        if isinstance(value, Tensor):
            wrong = value.dtype != torch.float32 and value.is_floating_point()
            if wrong or not value.is_cpu or value.numel() >= 2**31:
                return False
        elif isinstance(value, tuple | list) and not is_cpu_float32(*value):
            return False
    return True


class Operation(Generic[_P, _R]):
    """A function that runs its compiled version where there is one that suits; made by `operation`.

    Args:
        reference: the plain version.
        check: called first, with the same arguments; raises `InputError` if they do not fit each other.
    """

    def __init__(self, reference: Callable[_P, _R], check: Callable[..., object] | None) -> None:
        functools.update_wrapper(self, reference)
        self.reference = reference
        self.compiled: Callable[_P, _R] | None = None
        self._check = check
        self._suits: Callable[..., bool] = is_cpu_float32

    def __call__(self, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        """Check the arguments and run one of the versions."""
        if self._check is not None:
            self._check(*args, **kwargs)
        if self.compiled is not None and _choice != "torch" and self._suits(*args, **kwargs):
            return self.compiled(*args, **kwargs)
        return self.reference(*args, **kwargs)

    def register_cpu(
        self, *, suits: Callable[..., bool] = is_cpu_float32
    ) -> Callable[[Callable[_P, _R]], Callable[_P, _R]]:
        """Decorator of the compiled version for the CPU, which takes the same arguments.

        Args:
            suits: called with the arguments: whether the compiled version takes them.
        """

        def register(compiled: Callable[_P, _R]) -> Callable[_P, _R]:
            self.compiled, self._suits = compiled, suits
            _compiled.add(self.reference.__qualname__)
            return compiled

        return register


def operation(
    *, check: Callable[..., object] | None = None
) -> Callable[[Callable[_P, _R]], Operation[_P, _R]]:
    """Decorator that makes an `Operation` of a function in plain PyTorch."""

    def wrap(reference: Callable[_P, _R]) -> Operation[_P, _R]:
        return Operation(reference, check)

    return wrap
