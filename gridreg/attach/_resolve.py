"""Finding the tensors of a site on a field, and the sites that a field declares."""

from __future__ import annotations

import fnmatch
import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from torch import Tensor, nn
from torch.nn.parameter import is_lazy

from gridreg.attach.selectors import Selector
from gridreg.attach.sites import Grid, Place, Site, SiteLike, spatial_axes
from gridreg.errors import InputError, near_names

# DistributedDataParallel and DataParallel, and torch.compile.
_WRAPPERS = re.compile(r"^((module|_orig_mod)\.)+")

Part: TypeAlias = Literal["mask", "grids"]
Adapter: TypeAlias = Callable[[nn.Module], Mapping[str, "Site | Selector"]]

_ADAPTERS: dict[type[nn.Module], Adapter] = {}


@dataclass(eq=False)
class Match:
    """A place together with the module and the attribute that hold it."""

    place: Place
    module: nn.Module
    attribute: str

    def grids(self) -> list[Grid]:
        """The raw tensor behind this place, or each grid of a stack."""
        place, tensor = self.place, raw_tensor(self.module, self.attribute)
        stack = place.stack
        if stack is None:
            return [Grid(place.name, tensor, place.dim, place.spatial, place.selected)]
        dim = place.dim - (place.dim > stack)
        spatial = tuple(axis - (axis > stack) for axis in place.spatial)
        item = place.selector.item
        return [
            Grid(f"{place.name}[{i}]", tensor, dim, spatial, place.selected, (stack, i))
            for i in range(tensor.shape[stack])
            if item is None or i == item
        ]


def raw_tensor(module: nn.Module, attribute: str) -> Tensor:
    """The content of `_parameters` or `_buffers`, past any property that is attached."""
    tensor: Tensor | None = module._parameters.get(attribute)
    if tensor is None:
        tensor = module._buffers.get(attribute)
    if tensor is None:
        raise InputError(f"{attribute}: no longer a parameter or buffer of {type(module).__name__}")
    return tensor


def register_adapter(cls: type[nn.Module], function: Adapter) -> None:
    """Declare sites for a class of somebody else's: `function(field) -> {"density": Site(...), ...}`.

    Subclasses inherit the adapter; names given by an adapter go before those of the field's own `sites()`.
    """
    _ADAPTERS[cls] = function


def _declared_by(module: nn.Module) -> dict[str, Site]:
    """Sites that a module declares by itself or through adapters."""
    found: dict[str, Site | Selector] = {}
    declare = getattr(module, "sites", None)
    # Somebody else's method, attribute or submodule of that name is not a declaration.
    if inspect.ismethod(declare) and not inspect.signature(declare).parameters:
        declared = declare()
        if isinstance(declared, Mapping) and all(isinstance(s, (Site, Selector)) for s in declared.values()):
            found.update(declared)
    for cls in reversed(type(module).__mro__):
        if cls in _ADAPTERS:
            found.update(_ADAPTERS[cls](module))
    return {name: site if isinstance(site, Site) else Site((site,)) for name, site in found.items()}


def sites_of(field: nn.Module) -> dict[str, Site]:
    """Sites that a field declares, by name.

    A wrapper (DistributedDataParallel, a compiled module) that declares none shows those of the one module
    inside that does.
    """
    own = _declared_by(field)
    if own:
        return own
    inner = [
        (prefix, _declared_by(module)) for prefix, module in field.named_modules() if module is not field
    ]
    inner = [(prefix, sites) for prefix, sites in inner if sites]
    if not inner or any(not prefix.startswith(inner[0][0] + ".") for prefix, _ in inner[1:]):
        return {}
    prefix, sites = inner[0]
    return {name: _prefixed(site, prefix) for name, site in sites.items()}


def _declared_below(field: nn.Module) -> dict[str, Site]:
    """Sites that the parts of a field declare, each by its path: "field.density"."""
    return {
        f"{path}.{name}": _prefixed(site, path)
        for path, module in field.named_modules(remove_duplicate=False)
        if path
        for name, site in _declared_by(module).items()
    }


def _prefixed(site: Site, prefix: str) -> Site:
    """The same site seen from a module further out."""

    def moved(selectors: Iterable[Selector]) -> tuple[Selector, ...]:
        return tuple(replace(s, pattern=f"{prefix}.{s.pattern}".rstrip(".")) for s in selectors)

    return Site(moved(site.selectors("mask")), moved(site.selectors("grids")))


def find(field: nn.Module, site: SiteLike, part: Part, once: bool = False) -> list[Match]:
    """All tensors of a site, in the order of the field.

    Args:
        field: the module to look at.
        site: declared name, selector or `Site`.
        part: which of the site's selectors to follow.
        once: tied parameters at one of the names that match, not at each.

    Raises:
        InputError: nothing matches (near names are listed), or the channel axis or the channels do not fit.
    """
    if isinstance(site, str):
        declared = sites_of(field)
        by_path = declared if site in declared else _declared_below(field)
        if site not in by_path:
            names = [*declared, *by_path]
            raise InputError(
                _unknown(site, names, f"{type(field).__name__} declares no site of this name", _SITES)
            )
        site = by_path[site]
    if isinstance(site, Selector):
        site = Site((site,))
    return [match for selector in site.selectors(part) for match in _find_selector(field, selector, once)]


_SITES = "nor does any part of it; name tensors with gridreg.parameters, outputs or inputs"


def _unknown(name: str, names: Sequence[str], reason: str, none: str = "there are none here") -> str:
    """One line: what was asked, the near names, all names; `none` is said where there are no names."""
    ends = [n for n in names if n.endswith(f".{name}")]
    near = f"; did you mean {' or '.join(map(repr, ends[:3]))}?" if ends else near_names(name, names, 3)
    shown = ", ".join(repr(n) for n in names[:20]) + (", ..." if len(names) > 20 else "")
    listed = f"{near or '.'} Names: {shown}" if names else f"; {none}"
    return f"site {name!r}: {reason}{listed}"


def _matching(pattern: str, names: Iterable[str]) -> list[str]:
    """Names that match a glob whose wildcards stay within a dotted part, or, where none does, cross dots.

    Where nothing matches either, the prefixes that torch's wrappers put in front of all names do not count.
    """
    names = list(names)
    parts = pattern.split(".")
    within = [
        name
        for name in names
        if name.count(".") == len(parts) - 1
        and all(fnmatch.fnmatchcase(n, p) for n, p in zip(name.split("."), parts, strict=True))
    ]
    found = within or [name for name in names if fnmatch.fnmatchcase(name, pattern)]
    bare = {_WRAPPERS.sub("", name): name for name in names}
    if found or list(bare) == names:
        return found
    return [bare[name] for name in _matching(pattern, bare)]


def _find_selector(field: nn.Module, selector: Selector, once: bool) -> list[Match]:
    """Matches of one selector."""
    if selector.kind != "parameters":
        matches, once = _find_modules(field, selector), False
    else:
        matches = _find_parameters(field, selector)

    def key(match: Match) -> tuple[int, str]:
        owner, name = match.module, match.attribute
        return (id(raw_tensor(owner, name)), "") if once else (id(owner), name)

    # A module or list that is reachable under two names holds one tensor: attach once.
    unique = {key(match): match for match in reversed(matches)}
    return [match for match in matches if unique[key(match)] is match]


def _find_parameters(field: nn.Module, selector: Selector) -> list[Match]:
    """Parameters by name, else buffers, with their layout checked."""
    named: dict[str, Tensor] = dict(field.named_parameters(remove_duplicate=False))
    names = _matching(selector.pattern, named)
    if not names:
        buffers = {n: b for n, b in field.named_buffers(remove_duplicate=False) if b.is_floating_point()}
        names = _matching(selector.pattern, buffers)
        named |= buffers
    if not names:
        raise InputError(_unknown(selector.pattern, list(named), "matches no parameter or buffer"))
    tensors = {name: named[name] for name in names}
    for name, tensor in tensors.items():
        if is_lazy(tensor):
            raise InputError(f"{name}: is lazy, without a shape; call the field once before gridreg.apply")
    dims = {name: _checked_dim(name, tensor, selector) for name, tensor in tensors.items()}
    _check_sizes(tensors, dims, selector)
    matches = []
    for name, tensor in tensors.items():
        path, _, attribute = name.rpartition(".")
        stack = _checked_stack(name, tensor, dims[name], selector)
        spatial = spatial_axes(tensor, dims[name], selector.spatial, stack)
        place = Place(name, selector, dims[name], spatial, selector.octaves, stack=stack)
        place.complete(tensor.shape[dims[name]])
        matches.append(Match(place, field.get_submodule(path), attribute))
    return matches


def _find_modules(field: nn.Module, selector: Selector) -> list[Match]:
    """Submodules by name, for outputs and inputs."""
    modules = dict(field.named_modules(remove_duplicate=False))
    names = _matching(selector.pattern, modules)
    if not names:
        raise InputError(_unknown(selector.pattern, [n for n in modules if n], "matches no submodule"))
    matches = []
    for name in names:
        module = modules[name]
        octaves = selector.octaves
        if octaves is None and selector.kind == "outputs" and selector.channels is None:
            # Encodings that know their octaves, such as gridreg.PositionalEncoding.
            octaves = getattr(module, "channel_octaves", None)
        place = Place(name, selector, selector.dim, octaves=octaves)
        if isinstance(module, nn.Linear) and selector.dim == -1:
            place.complete(module.in_features if selector.kind == "inputs" else module.out_features)
        matches.append(Match(place, module, selector.kind))
    return matches


def _checked_dim(name: str, tensor: Tensor, selector: Selector) -> int:
    """The channel axis, not negative; refused where it is plainly spatial."""
    dim, count = selector.dim, tensor.ndim
    if not -count <= dim < count:
        raise InputError(
            f"dim={dim} of {selector}: {name} has shape {tuple(tensor.shape)}, axes 0 to {count - 1}"
        )
    dim %= count
    if selector.spatial is not None:
        if any(axis % count == dim for axis in selector.spatial):
            raise InputError(
                f"spatial={selector.spatial} of {selector}: names the channel axis {dim} of {name}"
            )
    elif count in (4, 5) and tensor.shape[0] == 1 and dim >= 2:
        raise InputError(
            f"dim={selector.dim} of {selector}: is a spatial axis of {name}, shape {tuple(tensor.shape)}; "
            "the channel axis is 1 (if it is not, say which axes are spatial with spatial=...)"
        )
    return dim


def _check_sizes(tensors: Mapping[str, Tensor], dims: Mapping[str, int], selector: Selector) -> None:
    """Refuse matches of unequal length along `dim`, a sign that the axis is spatial.

    Not where the layout is plain: axis 1 of `[1, C, ...]`, as `grid_sample` takes it, is the channel axis.
    """
    if selector.spatial is not None:
        return
    doubtful = {
        name: tensor.shape[dims[name]]
        for name, tensor in tensors.items()
        if not (tensor.ndim in (4, 5) and tensor.shape[0] == 1 and dims[name] == 1)
    }
    if len(set(doubtful.values())) > 1:
        listed = ", ".join(f"{name} {size}" for name, size in list(doubtful.items())[:6])
        raise InputError(
            f"dim={selector.dim} of {selector}: lengths differ ({listed}), so this axis looks spatial; "
            "name the channel axis, or, if it is one, the spatial axes with spatial=..."
        )


def _checked_stack(name: str, tensor: Tensor, dim: int, selector: Selector) -> int | None:
    """The axis of a stack, not negative; refused where it is another axis, or the item is not in it."""
    if selector.stack is None:
        return None
    shape, count = tuple(tensor.shape), tensor.ndim
    axis = selector.stack % count if -count <= selector.stack < count else count
    others = (dim, *(other % count for other in selector.spatial or ()))
    if axis == count or axis in others:
        raise InputError(
            f"stack={selector.stack} of {selector}: {name} has shape {shape}; expected another axis"
        )
    if selector.item is not None and selector.item not in range(shape[axis]):
        raise InputError(f"item={selector.item!r} of {selector}: {name} holds {shape[axis]} grids, from 0")
    return axis
