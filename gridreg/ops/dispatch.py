"""Which implementation of the inner loops runs: the plain one in PyTorch, or one that was registered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType

import torch
from torch import Tensor

from gridreg.errors import InputError
from gridreg.ops import ray_reference as plain

__all__ = [
    "Backend",
    "Marched",
    "backend_for",
    "chosen_backend",
    "register_backend",
    "registered_backends",
    "takes_compiled",
    "use_backend",
]

Marched = tuple[Tensor, Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class Backend:
    """One implementation of the inner loops; signatures as of the functions of the same name."""

    march: Callable[[Tensor, Tensor, Tensor, Tensor, float, Tensor, Tensor, Tensor | float], Marched]
    composite_weights: Callable[[Tensor, Tensor], Tensor]
    accumulate: Callable[[Tensor, Tensor, Tensor], Tensor]
    terminate: Callable[[Tensor, Tensor, float], Tensor]
    pool: Callable[[Tensor, Tensor, float, float, torch.Generator | None], tuple[Tensor, Tensor, Tensor]] = (
        plain.pool
    )
    spread: Callable[[Tensor, Tensor, Tensor], Tensor] = plain.spread
    pixels: Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]] = plain.pixels


_TORCH = Backend(plain.march, plain.composite_weights, plain.accumulate, plain.terminate)
_BACKENDS: dict[str, Backend] = {"torch": _TORCH}
_CHOICES = ("auto", "compiled", "torch")
_choice = "auto"


def register_backend(name: str, backend: Backend) -> None:
    """Make ``backend`` available as ``name``; a second registration replaces the first.

    Raises:
        InputError: for any name but "compiled"; "torch" is the reference and cannot be replaced.
    """
    if name != "compiled":
        raise InputError(
            f"backend name: found {name!r}, expected 'compiled' ('torch' is the fixed reference)"
        )
    _BACKENDS[name] = backend


def registered_backends() -> tuple[str, ...]:
    """Names of the backends that can be chosen now."""
    return tuple(sorted(_BACKENDS))


def chosen_backend() -> str:
    """The name given to the last `use_backend` that is still in force: "auto" by default."""
    return _choice


class use_backend:
    """Choose the implementation of the inner loops, for good or for the length of a ``with`` block.

    The choice holds for the whole process: a viewer's thread follows the trainer's.

    Args:
        name: "torch" forces the plain versions; "compiled" and "auto" take the compiled ones for CPU float32
            tensors and the plain ones for all others, "auto" also while nothing compiled is registered.

    Raises:
        InputError: for an unknown name, or for "compiled" while nothing is registered under it.

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
        if name == "compiled" and "compiled" not in _BACKENDS:
            raise InputError(
                "backend 'compiled': nothing is registered, expected `import gridreg.ops` before"
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


def takes_compiled(*tensors: Tensor) -> bool:
    """Whether the choice allows compiled code for these tensors: all on the CPU, all float32."""
    return _choice != "torch" and all(x.is_cpu and x.dtype == torch.float32 for x in tensors)


def backend_for(*tensors: Tensor) -> Backend:
    """The chosen implementation, or the plain one if these tensors are not for compiled code."""
    return _BACKENDS.get("compiled", _TORCH) if takes_compiled(*tensors) else _TORCH
