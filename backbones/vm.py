"""VM-TensoRF: planes times lines (Chen et al., TensoRF, ECCV 2022, equations 3 and 10)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from backbones.tensorial import TensorialField, resampled
from gridreg import ops
from gridreg.attach._hooks import open_channels
from gridreg.attach.selectors import parameters
from gridreg.attach.sites import Site
from gridreg.ops.interpolation import LINE_AXES, PLANE_AXES


class VMField(TensorialField):
    """A radiance field factored into three plane-line pairs.

    ``G(x) = sum_k sum_c plane_k[x_a, x_b, c] * line_k[x_v, c]``; for appearance the products are concatenated.
    Grids are channels-last: planes ``(A, B, C)``, lines ``(M, C)``.

    Args:
        bounds: ``(2, 3)``, world units.
        resolution: nodes along x, y, z.
        density_components, appearance_components: channels ``C`` of each plane-line pair (16 and 48 in TensoRF).
        scale: standard deviation of the initial values.
        generator: for the initial values.
        options: of `TensorialField`.
    """

    def __init__(
        self,
        bounds: Tensor,
        resolution: tuple[int, int, int],
        *,
        density_components: int = 16,
        appearance_components: int = 48,
        scale: float = 0.1,
        generator: torch.Generator | None = None,
        **options: Any,
    ) -> None:
        super().__init__(bounds, resolution, 3 * appearance_components, generator=generator, **options)
        self.density_planes, self.density_lines = _grids(resolution, density_components, scale, generator)
        self.appearance_planes, self.appearance_lines = _grids(
            resolution, appearance_components, scale, generator
        )

    def density_features(self, u: Tensor) -> Tensor:
        """``G(x)``: normalised positions ``(N, 3)`` to ``(N,)``."""
        return ops.vm_density(
            u,
            list(self.density_planes),
            list(self.density_lines),
            _open_components(self.density_planes, self.density_lines),
        )

    def appearance_features(self, u: Tensor) -> Tensor:
        """Normalised positions ``(N, 3)`` to the concatenated products ``(N, 3 C)``."""
        return self._products(u, torch.float32)

    def _components(self, u: Tensor) -> Tensor:
        return self._products(u, self.basis.input_dtype)

    def _products(self, u: Tensor, dtype: torch.dtype) -> Tensor:
        opened = _open_components(self.appearance_planes, self.appearance_lines)
        planes, lines = list(self.appearance_planes), list(self.appearance_lines)
        return ops.vm_features(u, planes, lines, opened, dtype)

    def _marched(
        self, march: ops.MarchArguments, activation: ops.Activation, transmittance_bound: float
    ) -> ops.RayMarchResult:
        opened = _open_components(self.density_planes, self.density_lines)
        return ops.vm_march_density(
            march,
            activation,
            transmittance_bound,
            list(self.density_planes),
            list(self.density_lines),
            opened,
        )

    @torch.no_grad()
    def resample(self, resolution: tuple[int, int, int]) -> None:
        """Replace every grid by its (bi)linear interpolation at new nodes (TensoRF's `upsample_volume_grid`).

        The corners stay where they are.
        """
        for planes, lines in self._pairs():
            for k in range(3):
                a, b = PLANE_AXES[k]
                planes[k] = nn.Parameter(resampled(planes[k], (resolution[a], resolution[b])))
                lines[k] = nn.Parameter(resampled(lines[k], (resolution[LINE_AXES[k]],)))
        self.resolution = resolution

    @torch.no_grad()
    def _crop(self, start: list[int], stop: list[int]) -> None:
        for planes, lines in self._pairs():
            for k in range(3):
                (a, b), v = PLANE_AXES[k], LINE_AXES[k]
                plane = planes[k][start[a] : stop[a], start[b] : stop[b]]
                planes[k] = nn.Parameter(plane.clone(memory_format=torch.contiguous_format))
                lines[k] = nn.Parameter(lines[k][start[v] : stop[v]].clone())

    def _pairs(self) -> tuple[tuple[nn.ParameterList, nn.ParameterList], ...]:
        return (self.density_planes, self.density_lines), (self.appearance_planes, self.appearance_lines)

    def sites(self) -> dict[str, Site]:
        """``density``, ``appearance`` (masks act on their lines), each also ``.planes`` and ``.lines``; encodings."""
        found = super().sites()
        for kind in ("density", "appearance"):
            planes = parameters(f"{kind}_planes.*", dim=-1)
            lines = parameters(f"{kind}_lines.*", dim=-1, spatial=(0,))
            found[kind] = Site(mask=lines, grids=(planes, lines))
            found[f"{kind}.planes"] = Site(mask=planes, grids=(planes,))
            found[f"{kind}.lines"] = Site(mask=lines, grids=(lines,))
        return found


def _open_components(planes: nn.ParameterList, lines: nn.ParameterList) -> int | None:
    """Components to read: at and beyond this index a mask has closed a factor of all three products."""
    products = []
    for k in map(str, range(3)):
        closed = [c for grids in (planes, lines) if (c := open_channels(grids, k)) is not None]
        if not closed:
            return None
        products.append(min(closed))
    return max(products)


def _grids(
    resolution: tuple[int, int, int], channels: int, scale: float, generator: torch.Generator | None
) -> tuple[nn.ParameterList, nn.ParameterList]:
    if channels < 1:
        raise ValueError(f"components: found {channels}, expected at least 1")
    planes, lines = nn.ParameterList(), nn.ParameterList()
    for (a, b), v in zip(PLANE_AXES, LINE_AXES, strict=True):
        planes.append(
            nn.Parameter(scale * torch.randn(resolution[a], resolution[b], channels, generator=generator))
        )
        lines.append(nn.Parameter(scale * torch.randn(resolution[v], channels, generator=generator)))
    return planes, lines
