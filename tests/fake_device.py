"""A CUDA device that is not there: tensors that say they are on it, and compute on the CPU.

PyTorch's `FakeTensorMode` refuses operations that mix devices, but has no values, so it stops where a size depends on
them, as that of every ray march does; and differentiating tensors on a fake CUDA device ends the process in builds of
PyTorch without CUDA. Here the values go along, and the same is refused: tensors of two devices, and NumPy.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = torch.device("cuda", 0)
aten = torch.ops.aten
# Indices on the CPU are allowed on CUDA.
_INDEXED = {aten.index, aten.index_put, aten.index_put_, aten._index_put_impl_}


class Away(Tensor):
    """A tensor of values that lie on the CPU, which says that they lie on `DEVICE`."""

    values: Tensor
    device = property(lambda self: DEVICE)  # type: ignore[assignment]
    is_cpu = property(lambda self: False)  # type: ignore[assignment]
    is_cuda = property(lambda self: True)  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, values: Tensor) -> Away:
        made: Away = Tensor._make_wrapper_subclass(
            cls, values.shape, values.stride(), values.storage_offset(), dtype=values.dtype, device="cpu"
        )
        made.values = values
        return made

    def __repr__(self) -> str:
        return f"Away({self.values})"

    def numpy(self, *, force: bool = False) -> Any:
        raise TypeError(f"can't convert {DEVICE} device type tensor to numpy. Use Tensor.cpu()")

    def __array__(self, dtype: Any = None) -> Any:
        return self.numpy()

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def data_ptr(self) -> int:
        return self.values.data_ptr()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class _Sent(torch.autograd.Function):
    """A copy on the other device."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, away: bool) -> Tensor:
        ctx.away = isinstance(value, Away)
        return _sent(value, away)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return _sent(gradient, ctx.away), None


def _sent(value: Tensor, away: bool) -> Tensor:
    values = value.values if isinstance(value, Away) else value
    return Away(values.detach().clone()) if away else values.detach().clone()


class FakeDevice(TorchFunctionMode):
    """Inside, `DEVICE` can be named wherever a device is."""

    def __enter__(self) -> FakeDevice:
        self._before = torch.__future__.get_overwrite_module_params_on_conversion()
        torch.__future__.set_overwrite_module_params_on_conversion(True)
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        torch.__future__.set_overwrite_module_params_on_conversion(self._before)

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        away = bool(args) and isinstance(args[0], Away)
        if func not in (Tensor.to, Tensor.cpu, Tensor.cuda):
            asked = kwargs.pop("device", None)
            made = func(*args, **kwargs)
            target = away if asked is None else torch.device(asked).type == DEVICE.type
            if asked is None and func is not Tensor.new_tensor:
                return made
            return made if isinstance(made, Away) == target else _Sent.apply(made, target)
        value, *rest = args
        target = away if func is Tensor.to else func is Tensor.cuda
        if func is Tensor.to:
            dtypes = []
            for other in [*rest, kwargs.pop("device", None)]:
                if isinstance(other, Tensor):
                    target = isinstance(other, Away)
                    dtypes = [other.dtype]
                elif isinstance(other, (str, torch.device)):
                    target = torch.device(other).type == DEVICE.type
                elif isinstance(other, torch.dtype):
                    dtypes = [other]
            value = func(value, *dtypes, **kwargs) if dtypes or kwargs else value
        return value if target == away else _Sent.apply(value, target)


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    packet = func.overloadpacket
    tensors = [value for value in tree_flatten((args, kwargs))[0] if isinstance(value, Tensor)]
    away = [value for value in tensors if isinstance(value, Away)]
    other = [value for value in tensors if not isinstance(value, Away) and value.dim()]
    there = bool(away)
    if packet in (aten.copy_, *_INDEXED) and not isinstance(args[0], Away):
        if packet is not aten.copy_ and away:
            raise RuntimeError(f"{func}: indices on {DEVICE} for a tensor on the CPU")
        there = False
    elif away and other and packet not in (aten.copy_, *_INDEXED):
        raise RuntimeError(f"{func}: tensors on {DEVICE} and on the CPU, {tuple(other[0].shape)}")
    inner = tree_map(lambda value: value.values if isinstance(value, Away) else value, (args, kwargs))
    result = func(*inner[0], **inner[1])
    if not there:
        return result
    # What was written in place is the tensor that was given.
    known = {id(value.values): value for value in away}

    def outer(value: Any) -> Any:
        if not isinstance(value, Tensor):
            return value
        return known[id(value)] if id(value) in known else Away(value)

    return tree_map(outer, result)
