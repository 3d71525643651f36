"""The base class of all regularizers, their registry, and the context that their methods get."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar

import torch
from torch import Tensor

from gridreg.attach.sites import Grid, Place, SiteLike, check_site, choices_of
from gridreg.errors import InputError
from gridreg.schedules import Numeric, check_numeric, end_step, resolve

if TYPE_CHECKING:
    from gridreg.samples import RaySamples


class Clock:
    """The step, the length of the run and the random generator that all contexts of one handle share.

    It survives `copy.deepcopy` and pickling, which a bare `torch.Generator` does not.
    """

    def __init__(self, total_steps: int, seed: int) -> None:
        self.step = 0
        self.total_steps = total_steps
        self.generator = torch.Generator().manual_seed(seed)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "generator": self.generator.get_state()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.generator = torch.Generator()
        self.generator.set_state(state["generator"])


@dataclass
class Context:
    """Step, tensor and memory that a regularizer's methods are called with.

    Attributes:
        clock: step, total_steps and generator of the handle.
        place: the tensor that a transform acts on; None in penalties and hooks.
        state: tensors that belong to the regularizer at this place; the handle saves, loads and keeps
            them, also when a parameter is replaced. Write into them in place: compiled code then sees it.
        prepared_at: the step at which `prepare` was called last; set by the handle.
    """

    clock: Clock
    place: Place | None = None
    state: dict[str, Tensor] = field(default_factory=dict, repr=False)
    prepared_at: int | None = None

    @property
    def step(self) -> int:
        """Current step, iterations."""
        return self.clock.step

    @property
    def total_steps(self) -> int:
        """Length of the run, iterations."""
        return self.clock.total_steps

    @property
    def generator(self) -> torch.Generator:
        """The handle's generator, on the CPU; its state is part of the handle's `state_dict`."""
        return self.clock.generator

    def step_generator(self) -> torch.Generator:
        """A generator that begins alike whenever it is asked for at one step: for penalties that draw at random."""
        return torch.Generator().manual_seed((self.generator.initial_seed() * 1_000_003 + self.step) % 2**63)

    def at(
        self, value: Numeric, name: str = "value", low: float = -float("inf"), high: float = float("inf")
    ) -> float:
        """The number that `value` stands for now; refused outside [low, high] under its `name`."""
        number = resolve(value, self.step, self.total_steps, name)
        if not low <= number <= high:
            raise InputError(
                f"{name}={number:g} at step {self.step}: expected a number in [{low:g}, {high:g}]"
            )
        return number

    def end(self, until: Numeric) -> int:
        """The step that `until` stands for (float: fraction of the run, int: step)."""
        return end_step(until, self.step, self.total_steps)


@dataclass(frozen=True, eq=False)
class LocalTerm:
    """A part of a grid penalty with a closed form, so that a fused optimizer step can add its gradient.

    The part equals `scale` times the form named by `kind`, with p the parameter:

    * "total_variation": sum over the spatial axes of mean((p[i + 1] - p[i])^2 along the axis)
    * "l1": mean(abs(p))
    * "l2": mean(p^2)

    Attributes:
        name: the regularizer's name in `handle.terms` (the handle fills it in).
        kind: one of the above.
        scale: factor; from the regularizer without its weight, from `handle.grid_terms()` with it.
        parameter: the raw parameter.
        spatial: its spatial axes.
    """

    kind: Literal["total_variation", "l1", "l2"]
    scale: float
    parameter: Tensor = field(repr=False)
    spatial: tuple[int, ...]
    name: str = ""


@dataclass(frozen=True)
class Regularizer:
    """Base of all regularizers: a frozen dataclass whose fields are its configuration.

    A regularizer overrides one or more of the methods below; each does nothing by default. Whatever changes
    during a run lives in the context's state.

    Class attributes:
        acts_on: the part of a declared site that `transform` acts on: "mask" (channel masks) or "grids"
            (low-passes).
        train_only: skip `transform` while the module that owns the tensor is in eval mode.
        shown: the field whose number stands in tables and curves.
        ranges: lowest and highest value of fields that are numbers or schedules; None is let through.
        counts: fields that are ints above 0 (or None, where that is the default), with what each is in words.
        required: attributes of the samples that `penalty` reads and that a renderer may leave out (None).
        example_arguments: what instances for `gridreg.testing.check_regularizer` are made with, beside the site.

    Two fields have a meaning where a subclass has them: `weight` is the factor of its penalties, and
    `detach=True` says that `transform` leaves values as they are and changes only gradients.
    """

    acts_on: ClassVar[Literal["mask", "grids"]] = "mask"
    train_only: ClassVar[bool] = False
    shown: ClassVar[str] = "weight"
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {}
    counts: ClassVar[Sequence[tuple[str, str]]] = ()
    required: ClassVar[tuple[str, ...]] = ()
    example_arguments: ClassVar[Sequence[Mapping[str, Any]]] = ()

    def __post_init__(self) -> None:
        """Refuse at once what can be refused before the first step.

        Raises:
            InputError: a site or weight that is none, a number outside its range, a text that is none of the choices.
        """
        known = self.__dataclass_fields__
        # A site may be left out where its own default says so.
        if "site" in known and (self.site is not None or known["site"].default is not None):  # type: ignore[attr-defined]
            check_site(self.site)  # type: ignore[attr-defined]
        if "weight" in known:
            check_numeric("weight", self.weight, low=0.0)  # type: ignore[attr-defined]
        for name, (low, high) in self.ranges.items():
            if getattr(self, name) is not None:
                check_numeric(name, getattr(self, name), low, high)
        for name, expected in self.counts:
            value = getattr(self, name)
            unset = value is None and known[name].default is None
            if not unset and (isinstance(value, bool) or not hasattr(value, "__index__") or value < 1):
                raise InputError(f"{name}={value!r}: expected {expected}")
        for name, choices in choices_of(type(self)).items():  # type: ignore[arg-type]
            if getattr(self, name) not in choices:
                *first, last = map(repr, choices)
                raise InputError(f"{name}={getattr(self, name)!r}: expected {', '.join(first)} or {last}")

    def now(self, name: str, context: Context) -> float:
        """The number that a field stands for at the context's step; refused outside its range."""
        return context.at(getattr(self, name), name, *self.ranges.get(name, (-float("inf"), float("inf"))))

    def sites(self) -> tuple[SiteLike, ...]:
        """Sites that it attaches to or reads; by default the field `site`, or none."""
        site = getattr(self, "site", None)
        return () if site is None else (site,)

    # --- features and parameters -------------------------------------------------------------------

    def prepare(self, context: Context) -> None:
        """Called at each `handle.step` and when attaching: compute what `transform` needs into the state."""

    def transform(self, value: Tensor, context: Context) -> Tensor:
        """The tensor that the field sees at `context.place` instead of `value`, a function of it and the state.

        May be called once for several reads of a parameter that lie between two steps.
        """
        return value

    def is_identity(self, context: Context) -> bool:
        """True: `transform` is skipped until the next step. Asked after `prepare`."""
        return False

    def is_over(self, context: Context) -> bool:
        """True: from this step on it is the identity for good, so a slot that is idle already need not ask again."""
        return False

    def closed_channels(self, context: Context) -> Tensor | None:
        """Channels of the tensor that are exactly 0 after `transform`: ``(channels,)`` bool; None: none are."""
        return None

    # --- losses ------------------------------------------------------------------------------------

    def needs(self) -> tuple[str, ...]:
        """Attributes of the samples that `penalty` reads and that a renderer may leave out (None)."""
        return self.required

    def penalty(self, samples: RaySamples, context: Context) -> Tensor:
        """Scalar from the samples of a batch, without the weight."""
        return torch.zeros(())

    def grid_penalty(self, grids: Sequence[Grid], context: Context) -> Tensor:
        """Scalar from the raw grids of the site, without the weight."""
        return torch.zeros(())

    def local_terms(self, grids: Sequence[Grid], context: Context) -> list[LocalTerm]:
        """The grid penalty as closed forms per parameter, without the weight, or [] if it has none."""
        return []

    # --- samples, data, sampling, optimizer --------------------------------------------------------

    def on_samples(self, samples: RaySamples, context: Context) -> RaySamples:
        """The samples that the loss and the compositing get to see."""
        return samples

    def background(
        self, count: int, generator: torch.Generator, default: Tensor | None, context: Context
    ) -> Tensor | None:
        """Background colours `(count, 3)` of a batch of training rays, or the default `(3,)`, or None."""
        return default

    def near_far(self, near: Tensor, far: Tensor, context: Context) -> tuple[Tensor, Tensor]:
        """Interval of the training rays, world units, shapes `(R,)`."""
        return near, far

    def parameter_groups(
        self, groups: list[dict[str, Any]], grids: Sequence[Grid], context: Context
    ) -> list[dict[str, Any]]:
        """Optimizer parameter groups, split or changed. Asked whenever an optimizer is made."""
        return groups

    def update_groups(self, groups: list[dict[str, Any]], grids: Sequence[Grid], context: Context) -> None:
        """Bring schedule-driven entries of the optimizer's groups up to date, in place, at each step."""

    # --- telling -----------------------------------------------------------------------------------

    def value(self, context: Context) -> float:
        """One number for tables and curves: that of the field `shown` now, 1 for those without it."""
        return self.now(self.shown, context) if hasattr(self, self.shown) else 1.0

    @classmethod
    def examples(cls, site: SiteLike) -> list[Regularizer]:
        """Instances for `gridreg.testing.check_regularizer`, at `site` where the class takes one."""
        place = {"site": site} if "site" in cls.__dataclass_fields__ else {}
        return [cls(**place, **arguments) for arguments in cls.example_arguments]


RegularizerClass = TypeVar("RegularizerClass", bound=type[Regularizer])

REGISTRY: dict[str, type[Regularizer]] = {}
"""Regularizer classes by name, as configurations and the contract suite know them."""


def register(cls: RegularizerClass) -> RegularizerClass:
    """Class decorator: make a regularizer known to `from_config` and to the contract suite by its class name.

    Raises:
        InputError: it is not a frozen dataclass.
    """
    # Of its own: the base class is a dataclass too, so `is_dataclass` would say yes to any subclass.
    if "__dataclass_params__" not in vars(cls) or not cls.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise InputError(
            f"{cls.__name__}: a regularizer is a frozen dataclass; put @dataclass(frozen=True) below"
        )
    REGISTRY[cls.__name__] = cls
    return cls


def overrides(regularizer: Regularizer | type[Regularizer], method: str | Callable[..., object]) -> bool:
    """Whether a regularizer's class overrides a method of `Regularizer`, given as it is or by name."""
    name = method if isinstance(method, str) else method.__name__
    cls = regularizer if isinstance(regularizer, type) else type(regularizer)
    own, default = getattr(cls, name), getattr(Regularizer, name)
    return getattr(own, "__func__", own) is not getattr(default, "__func__", default)
