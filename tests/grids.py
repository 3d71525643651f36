"""A module with parameters of every kind, and selectors for each of them."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gridreg import parameters

HALF = {"visible_ratio": 0.5}


class Grids(nn.Module):
    """Parameters of every kind: own, in a list, in a dict, nested, tied, and a buffer."""

    def __init__(self) -> None:
        super().__init__()
        self.own = nn.Parameter(torch.rand(4, 6) + 1)
        self.lines = nn.ParameterList(nn.Parameter(torch.rand(1, 6, n, 1) + 1) for n in (2, 3))
        self.named = nn.ParameterDict({"a": nn.Parameter(torch.rand(6, 2) + 1)})
        self.nested = nn.ModuleList([nn.Linear(5, 6), nn.Linear(5, 6)])
        self.nested[1].weight = self.nested[0].weight
        self.register_buffer("table", torch.rand(3, 6) + 1)

    def parts(self) -> dict[str, Tensor]:
        """Every tensor with its six channels first."""
        return {
            "own": self.own.T,
            "lines.0": self.lines[0][0, :, :, 0],
            "lines.1": next(line for i, line in enumerate(self.lines) if i == 1)[0, :, :, 0],
            "named.a": self.named["a"],
            "nested.0.weight": self.nested[0].weight,
            "nested.1.weight": self.nested[1].weight,
            "table": self.table.T,
        }

    def forward(self, x: Tensor) -> Tensor:
        features = x + sum(part.sum(1) for part in self.parts().values())
        return features + self.nested[1](x[..., :5])


SELECTORS = {
    "own": parameters("own", dim=1),
    "lines.0": parameters("lines.*", dim=1),
    "lines.1": parameters("lines.*", dim=1),
    "named.a": parameters("named.a", dim=0),
    "nested.0.weight": parameters("nested.0.weight", dim=0),
    "nested.1.weight": parameters("nested.1.weight", dim=0),
    "table": parameters("table", dim=1),
}


def made() -> Grids:
    torch.manual_seed(0)
    return Grids()
