"""Methods of a field that somebody else calls, wrapped to run while nothing is attached; and what ends that."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any
from weakref import ref

from torch import nn

from gridreg.attach._hooks import attach
from gridreg.errors import InputError, near_names

if TYPE_CHECKING:
    from gridreg.attach._attachment import Attachment
    from gridreg.attach._slots import Slot


class SuspendingMethod:
    """Stands in an object's `__dict__` in front of the method of its class."""

    def __init__(self, attachment: Attachment, owner: Any, name: str) -> None:
        # Weak: the field holds this, and must not keep a dropped handle alive.
        self._attachment: ref[Attachment] | None = ref(attachment)
        self._owner, self._name = owner, name
        self._method = getattr(owner, name)
        self._before = {name: owner.__dict__[name]} if name in owner.__dict__ else {}
        owner.__dict__[name] = self

    def __getstate__(self) -> dict[str, Any]:
        """A copy of the field has the method, without a handle to suspend."""
        return {**self.__dict__, "_attachment": None}

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """The method's result, computed inside `suspended`."""
        attachment = None if self._attachment is None else self._attachment()
        if attachment is None or attachment.removed:
            return self._method(*arguments, **keywords)
        with attachment.suspended():
            return self._method(*arguments, **keywords)

    def unwrap(self) -> None:
        """Put back what was there."""
        if self._owner.__dict__.get(self._name) is self:
            del self._owner.__dict__[self._name]
            self._owner.__dict__.update(self._before)


def wrap(attachment: Attachment, field: nn.Module, path: str) -> SuspendingMethod:
    """Put a `SuspendingMethod` in front of a method, named by its dotted path from the field.

    Raises:
        InputError: there is no such method; near names are listed.
    """
    owner: Any = field
    *parents, name = path.split(".")
    for parent in parents:
        owner = getattr(owner, parent, None)
    if not callable(getattr(owner, name, None)) or not hasattr(owner, "__dict__"):
        names = [
            ".".join([*parents, n])
            for n in dir(owner)
            if not n.startswith("_") and callable(getattr(type(owner), n, None))
        ]
        hint = near_names(path, names, count=3)
        raise InputError(f"suspends({path!r}): {type(field).__name__} has no such method{hint}")
    return SuspendingMethod(attachment, owner, name)


def resume(
    attachments: Sequence[Attachment], orphans: Sequence[tuple[nn.Module, str, Slot]]
) -> Exception | None:
    """Attach everything again; the first error is returned when all others are back."""
    first: Exception | None = None
    for entry in orphans:
        attach(*entry)
    for attachment in attachments:
        attachment._suspensions -= 1
        if attachment._suspensions == 0 and not attachment.removed:
            try:
                attachment.attach()
            except Exception as error:
                first = first or error
    return first
