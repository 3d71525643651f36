"""A class for one instance: its own class, with properties over the tensors that transforms act on."""

from __future__ import annotations

import types
from collections.abc import Callable
from typing import Any, cast
from weakref import WeakValueDictionary

from torch import nn

__all__ = ["STACKS", "set_instance_class"]

STACKS = "_gridreg_stacks"
"""Entry of a module's `__dict__`: for each tensor, the slots that act on it, in order."""

_BASE = "_gridreg_base"
_NAMES = "_gridreg_names"

_CLASSES: WeakValueDictionary[tuple[type[nn.Module], tuple[str, ...]], type[nn.Module]] = (
    WeakValueDictionary()
)


def set_instance_class(module: nn.Module, names: tuple[str, ...] | None) -> None:
    """Give a module the class with properties for `names`, or, for None, its original class.

    A module with hooks alone gets a class without properties: compiled code looks at the class of a module,
    but not at its hooks, so this is how it notices that something was attached.
    """
    cls = type(module)
    base: type[nn.Module] = cls.__dict__.get(_BASE, cls)
    module.__class__ = base if names is None else _instance_class(base, names)


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
        cls = types.new_class(
            base.__name__, (base,), {"metaclass": type(base)}, lambda body: body.update(members)
        )
        _CLASSES[base, names] = cls
    return cls


def _property(name: str) -> property:
    """Property that transforms the raw tensor of this name."""

    def get(self: nn.Module) -> Any:
        own = self.__dict__
        value = own["_parameters"].get(name)
        if value is None:
            value = own["_buffers"].get(name)
        if value is None:
            # The name was deleted or holds None, which is how torch itself finds it then.
            return nn.Module.__getattr__(self, name)
        for slot in own.get(STACKS, {}).get(name, ()):
            value = slot(value, self.training)
        return value

    return property(get)


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
    module.__class__ = _instance_class(base, names)
    return module
