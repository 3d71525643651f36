"""A class for one instance: its own class, with properties over the tensors that transforms act on."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, cast
from weakref import WeakValueDictionary

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize, prune

STACKS = "_gridreg_stacks"
"""Entry of a module's `__dict__`: for each tensor, the stack of slots that acts on it."""

_BASE = "_gridreg_base"
_NAMES = "_gridreg_names"

_CLASSES: WeakValueDictionary[tuple[type[nn.Module], tuple[str, ...]], type[nn.Module]] = (
    WeakValueDictionary()
)

# torch reads attributes in some places where it means parameters: `get_parameter` would refuse a masked tensor,
# and `register_parametrization` would store it for good. These callers get the parameter. The reading frame is
# all that tells them apart, and it reaches every module above the attached one, which a method could not
# (test_torch_gets_parameters_where_it_means_them).
_RAW_READERS = frozenset(
    function.__code__
    for function in (
        nn.Module.get_parameter,
        nn.Module.get_buffer,
        parametrize.register_parametrization,
        cast(Any, prune.BasePruningMethod.apply).__func__,
    )
)


def set_instance_class(module: nn.Module, names: tuple[str, ...] | None) -> None:
    """Give a module the class with properties for `names`, or, for None, its original class.

    A module with hooks alone gets a class without properties: compiled code looks at the class of a module,
    but not at its hooks, so this is how it notices that something was attached.
    """
    cls = type(module)
    base: type[nn.Module] = cls.__dict__.get(_BASE, cls)
    wanted = base if names is None else _instance_class(base, names)
    if wanted is not cls:
        # Past a `__setattr__` of the class's own, which may refuse.
        object.__setattr__(module, "__class__", wanted)


def _instance_class(base: type[nn.Module], names: tuple[str, ...]) -> type[nn.Module]:
    """The subclass of `base` with a property for each name, the same object for the same arguments."""
    cls = _CLASSES.get((base, names))
    if cls is None:
        members: dict[str, Any] = {name: _property(name) for name in names}
        members |= {
            _BASE: base,
            _NAMES: names,
            "__reduce_ex__": _reduce_ex,
            "__module__": base.__module__,
            "__qualname__": base.__qualname__,
            "__doc__": base.__doc__,
        }
        cls = type.__new__(type(base), base.__name__, (_shield(base), base), members)
        _CLASSES[base, names] = cls
    return cls


def _shield(base: type) -> type:
    """A class that keeps `__init_subclass__` of a user's class, which may register or count, from what comes after it.

    It has the bases of the class that gave `base` its `__dict__`, so that Python allows to assign `__class__`. That it
    is made by `type` itself keeps a metaclass from registering it.
    """
    root = base
    while "__dict__" not in vars(root):
        root = cast(type, root.__base__)
    nothing = classmethod(lambda cls, **arguments: None)
    return type.__new__(type(root), base.__name__, root.__bases__, {"__init_subclass__": nothing})


def _property(name: str) -> property:
    """Property that transforms the raw tensor of this name."""

    def get(self: nn.Module) -> Any:
        own = self.__dict__
        value = own["_parameters"].get(name)
        if value is None:
            value = own["_buffers"].get(name)
        if value is None:
            # Where DataParallel keeps the tensors of its replicas, and whoever replaced a parameter by a tensor.
            value = own.get(name)
        if value is None:
            # The name was deleted or holds None, which is how torch itself finds it then.
            return nn.Module.__getattr__(self, name)
        stack = own.get(STACKS, {}).get(name)
        if stack is None or not isinstance(value, Tensor):
            return value
        if not torch.compiler.is_compiling() and sys._getframe(1).f_code in _RAW_READERS:
            return value
        try:
            return stack(value, self.training)
        except AttributeError as error:
            # Python would take it for a missing attribute and ask torch, which has the raw tensor: a regularizer with a
            # slip of the pen would have no effect, without a word.
            raise RuntimeError(f"{name}: a regularizer on it raised {error!r}") from error

    def put(self: nn.Module, value: Any) -> None:
        self.__dict__[name] = value

    def delete(self: nn.Module) -> None:
        if self.__dict__.pop(name, self) is self:
            raise AttributeError(name)

    return property(get, put, delete)


def _reduce_ex(self: nn.Module, protocol: Any) -> Any:
    """Pickle and copy by the original class and the names: the subclass itself cannot be imported."""
    cls: type[nn.Module] = next(cls for cls in type(self).__mro__ if _BASE in cls.__dict__)
    base, names = cls.__dict__[_BASE], cls.__dict__[_NAMES]
    reduced = cast(tuple[Any, ...], super(cls, self).__reduce_ex__(protocol))
    if cls is not type(self):
        # Somebody else made a class on top of ours, and has to know how to make it again.
        return reduced
    function, arguments, *rest = reduced
    arguments = tuple(base if argument is cls else argument for argument in arguments)
    return (_rebuild, (base, names, function, arguments), *rest)


def _rebuild(
    base: type[nn.Module],
    names: tuple[str, ...],
    function: Callable[..., nn.Module],
    arguments: tuple[Any, ...],
) -> nn.Module:
    """The empty module, with its properties; its state follows."""
    module = function(*arguments)
    set_instance_class(module, names)
    return module
