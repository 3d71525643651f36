"""Naming places on a field: the four ways, layouts, and what is refused."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

import gridreg
from gridreg.attach._resolve import Match, find
from gridreg.attach.selectors import Selector
from gridreg.attach.sites import Site


class Block(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(4, 6)
        self.register_buffer("table", torch.rand(10, 4))
        self.register_buffer("counts", torch.zeros(3, dtype=torch.long))

    def forward(self, x: Tensor) -> Tensor:
        return self.linear(x)


class Field(nn.Module):
    """Lists, nesting, buffers, and a layer that is reachable under two names."""

    def __init__(self) -> None:
        super().__init__()
        self.plane = nn.ParameterList(nn.Parameter(torch.rand(1, 8, n, n + 1)) for n in (5, 6))
        self.line = nn.ParameterList(nn.Parameter(torch.rand(1, 8, n, 1)) for n in (5, 6, 7))
        self.last = nn.ParameterList(nn.Parameter(torch.rand(n, n + 1, 8)) for n in (5, 6))
        self.blocks = nn.ModuleList(Block() for _ in range(2))
        self.alias = self.blocks[0]
        self.head = nn.Sequential(nn.Linear(6, 5), nn.Linear(5, 3))

    def sites(self) -> dict[str, Any]:
        lines = gridreg.parameters("line.*", dim=1)
        return {
            "density": Site(mask=lines, grids=(gridreg.parameters("plane.*", dim=1), lines)),
            "head": gridreg.outputs("head.0"),
        }


def names(matches: list[Match]) -> list[str]:
    return [match.place.name for match in matches]


def test_globs_stay_within_a_dotted_part_or_cross_dots_if_nothing_matches() -> None:
    field = Field()
    assert names(find(field, gridreg.parameters("line.*", dim=1), "mask")) == ["line.0", "line.1", "line.2"]
    assert names(find(field, gridreg.parameters("line*", dim=1), "mask")) == ["line.0", "line.1", "line.2"]
    assert names(find(field, gridreg.parameters("line.[02]", dim=1), "mask")) == ["line.0", "line.2"]
    assert names(find(field, gridreg.outputs("head.*"), "mask")) == ["head.0", "head.1"]
    assert names(find(field, gridreg.outputs("blocks.*"), "mask")) == ["blocks.0", "blocks.1"]
    assert names(find(field, gridreg.outputs("blocks.*.linear"), "mask")) == [
        "blocks.0.linear",
        "blocks.1.linear",
    ]
    assert names(find(field, gridreg.outputs(""), "mask")) == [""]


def test_a_module_under_two_names_is_one_place_and_tied_parameters_are_two() -> None:
    field = Field()
    assert names(find(field, gridreg.outputs("*.linear"), "mask")) == ["alias.linear"]
    assert len(find(field, gridreg.parameters("*linear.weight", dim=1), "mask")) == 2
    tied = nn.Module()
    tied.first, tied.second = nn.Linear(3, 3), nn.Linear(3, 3)
    tied.second.weight = tied.first.weight
    assert names(find(tied, gridreg.parameters("*.weight", dim=1), "mask")) == [
        "first.weight",
        "second.weight",
    ]


def test_buffers_match_where_no_parameter_does() -> None:
    field = Field()
    assert names(find(field, gridreg.parameters("blocks.*.table", dim=1), "mask")) == [
        "blocks.0.table",
        "blocks.1.table",
    ]
    with pytest.raises(gridreg.InputError, match=r"blocks\.0\.counts"):
        find(field, gridreg.parameters("blocks.0.counts", dim=0), "mask")


def test_declared_sites_have_a_mask_and_grids() -> None:
    field = Field()
    assert names(find(field, "density", "mask")) == ["line.0", "line.1", "line.2"]
    assert names(find(field, "density", "grids")) == ["plane.0", "plane.1", "line.0", "line.1", "line.2"]
    assert list(gridreg.sites_of(field)) == ["density", "head"]
    assert find(field, "head", "grids") == []
    grids = [grid for match in find(field, "density", "grids") for grid in match.grids()]
    assert [grid.spatial for grid in grids] == [(2, 3), (2, 3), (2,), (2,), (2,)]
    assert grids[0].parameter is field.plane[0]


@pytest.mark.parametrize(
    ("shape", "dim", "spatial", "expected"),
    [
        ((1, 8, 5, 6), 1, None, (2, 3)),
        ((1, 8, 5, 1), 1, None, (2,)),
        ((1, 8, 5, 6, 7), 1, None, (2, 3, 4)),
        ((8, 5, 6), 0, None, (1, 2)),
        ((5, 6, 8), -1, None, (0, 1)),
        ((5, 8), -1, (0,), (0,)),
        # A table, of which nobody knows whether its entries are neighbours in space.
        ((5, 8), -1, None, ()),
        ((5, 8), 1, None, ()),
        ((4, 5000, 8), -1, None, ()),
        ((8, 5), 0, None, (1,)),
        ((5, 6, 7, 8), -1, None, (0, 1, 2)),
        ((5, 8, 6), 1, (0, -1), (0, 2)),
        ((1, 5, 6, 7, 8), -1, (1, 2, 3), (1, 2, 3)),
        ((8,), 0, None, ()),
    ],
)
def test_spatial_axes(shape: tuple[int, ...], dim: int, spatial: Any, expected: tuple[int, ...]) -> None:
    field = nn.ParameterDict({"grid": nn.Parameter(torch.zeros(shape))})
    (match,) = find(field, gridreg.parameters("grid", dim=dim, spatial=spatial), "mask")
    assert match.place.spatial == expected
    assert match.place.size == 8


def test_channels_are_a_slice_or_indices() -> None:
    field = Field()
    place = find(field, gridreg.inputs("head.0", channels=slice(2, None)), "mask")[0].place
    assert (place.selected, place.channels) == ((2, 3, 4, 5), 4)
    place = find(field, gridreg.inputs("head.0", channels=[5, 0]), "mask")[0].place
    assert place.selected == (5, 0)
    assert gridreg.inputs("a", channels=slice(1, 9, 2)).channels == "1:9:2"
    assert gridreg.inputs("a", channels=slice(-3, None)) == gridreg.inputs("a", channels="-3:")
    grid = find(field, gridreg.parameters("head.0.weight", dim=1, channels=[1, 2]), "grids")[0].grids()[0]
    assert torch.equal(grid.values, field.head[0].weight[:, 1:3])


@pytest.mark.parametrize(
    ("site", "text"),
    [
        ("densty", r"site 'densty'.*did you mean 'density'\? Names: 'density', 'head'"),
        (gridreg.parameters("lines.*", dim=1), r"'lines\.\*'.*did you mean .*'line\.0'"),
        (gridreg.outputs("haed"), "did you mean 'head'"),
        (gridreg.inputs("mlp.0"), "matches no submodule"),
        (gridreg.parameters("line.*", dim=2), r"dim=2 .*is a spatial axis of line\.0.*channel axis is 1"),
        (gridreg.parameters("line.*", dim=4), r"dim=4 .*axes 0 to 3"),
        (gridreg.parameters("last.*", dim=0), r"dim=0 .*lengths differ \(last\.0 5, last\.1 6\)"),
        (gridreg.parameters("last.*", dim=-1, spatial=(0, 2)), "names the channel axis 2"),
        (gridreg.inputs("head.0", channels=slice(0, 9)), r"channels='0:9'.*head\.0 has 6 channels"),
        (gridreg.inputs("head.0", channels=[6]), r"channels=\(6,\).*has 6 channels"),
        (gridreg.inputs("head.0", octaves=[0, 1]), r"found 2, expected one for each of the 6"),
        (gridreg.parameters("line.*", dim=1, octaves=[0] * 9), "found 9, expected one for each of the 8"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(site: Any, text: str) -> None:
    field = Field()
    before = [type(module) for module in field.modules()]
    with pytest.raises(gridreg.InputError, match=text) as caught:
        gridreg.apply(field, gridreg.FrequencyMask(site), total_steps=10)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("FrequencyMask(")
    assert [type(module) for module in field.modules()] == before


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: gridreg.parameters(3, dim=1), "parameters"),
        (lambda: gridreg.parameters("a", dim="x"), "dim='x'"),
        (lambda: gridreg.parameters("a", dim=True), "dim=True"),
        (lambda: gridreg.inputs("a", channels="all"), "channels='all'"),
        (lambda: gridreg.inputs("a", channels=[]), "distinct indices"),
        (lambda: gridreg.inputs("a", channels=[1, 1]), "distinct indices"),
        (lambda: gridreg.inputs("a", channels=[-1]), "distinct indices"),
    ],
)
def test_bad_selectors_are_refused_when_made(make: Any, text: str) -> None:
    with pytest.raises(gridreg.InputError, match=text):
        make()


def test_unequal_channel_counts_need_a_plain_layout_or_explicit_spatial_axes() -> None:
    plain = nn.ParameterList(nn.Parameter(torch.zeros(1, channels, 9, 1)) for channels in (16, 4, 4))
    matches = find(plain, gridreg.parameters("*", dim=1), "mask")
    assert [match.place.size for match in matches] == [16, 4, 4]
    last = nn.ParameterList(nn.Parameter(torch.zeros(9, channels)) for channels in (16, 4, 4))
    with pytest.raises(gridreg.InputError, match=r"lengths differ \(0 16, 1 4, 2 4\)"):
        find(last, gridreg.parameters("*", dim=1), "mask")
    matches = find(last, gridreg.parameters("*", dim=1, spatial=(0,)), "mask")
    assert [match.place.size for match in matches] == [16, 4, 4]


def test_selectors_and_sites_compare_by_value_and_read_well() -> None:
    assert gridreg.parameters("a.*", 1) == gridreg.parameters("a.*", dim=1)
    assert Site(gridreg.outputs("a")) == Site((gridreg.outputs("a"),), ())
    assert hash(Site(gridreg.outputs("a"))) == hash(Site([gridreg.outputs("a")]))
    assert str(gridreg.inputs("a", channels=range(3), octaves=[0, 0, 1])) == (
        "inputs('a', dim=-1, channels=(0, 1, 2), octaves=...)"
    )


class Foreign(nn.Module):
    """A class of somebody else's whose `sites` are something else."""

    def __init__(self) -> None:
        super().__init__()
        self.grid = nn.Parameter(torch.rand(4, 5))

    def sites(self) -> list[str]:
        return ["https://example.org"]

    def forward(self) -> Tensor:
        return self.grid.sum(0)


class ForeignChild(Foreign):
    pass


class OddlyNamed(Foreign):
    def sites(self, planet: str) -> list[str]:  # type: ignore[override]
        return [planet]


@pytest.fixture
def adapter() -> Any:
    from gridreg.attach import _resolve as finding

    gridreg.register_adapter(Foreign, lambda field: {"grid": gridreg.parameters("grid", dim=1)})
    yield
    del finding._ADAPTERS[Foreign]


def test_an_adapter_declares_sites_for_a_foreign_class_and_its_children(adapter: None) -> None:
    for field in (Foreign(), ForeignChild()):
        assert list(gridreg.sites_of(field)) == ["grid"]
        with gridreg.apply(field, gridreg.FixedMask("grid", visible_ratio=0.4), total_steps=10):
            assert (field()[2:] == 0).all()
            assert list(gridreg.sites_of(field)) == ["grid"]


@pytest.mark.parametrize("cls", [Foreign, OddlyNamed])
def test_without_an_adapter_a_foreign_sites_method_is_no_declaration(cls: type[Foreign]) -> None:
    assert gridreg.sites_of(cls()) == {}
    with pytest.raises(gridreg.InputError, match="nor does any part of it"):
        gridreg.apply(cls(), gridreg.FixedMask("grid"), total_steps=10)


class Wrapper(nn.Module):
    def __init__(self, *fields: nn.Module) -> None:
        super().__init__()
        self.inner = nn.ModuleList(fields)


def test_a_wrapper_shows_the_sites_of_the_one_field_inside() -> None:
    wrapper = Wrapper(Field())
    assert names(find(wrapper, "density", "mask")) == ["inner.0.line.0", "inner.0.line.1", "inner.0.line.2"]
    assert names(find(wrapper, "head", "mask")) == ["inner.0.head.0"]
    assert gridreg.sites_of(Wrapper(Field(), Field())) == {}
    assert isinstance(gridreg.sites_of(wrapper)["density"].selectors("mask")[0], Selector)
