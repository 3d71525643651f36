"""CP-TensoRF: three lines multiplied together (Chen et al., TensoRF, ECCV 2022, section 3)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from backbones.tensorial import TensorialField, resampled
from gridreg import ops
from gridreg.attach._hooks import open_channels
from gridreg.attach.selectors import parameters
from gridreg.attach.sites import Site
from gridreg.ops.interpolation import LINE_AXES


class CPField(TensorialField):
    """A radiance field factored into products of three lines.

    ``G(x) = sum_c line_0[z, c] * line_1[y, c] * line_2[x, c]``; for appearance the products of the components stay
    apart. Lines are channels-last, ``(M, C)``: a field to 500^3 takes 1,500 rows, 2.3 MB in all.

    Args:
        bounds: ``(2, 3)``, world units.
        resolution: nodes along x, y, z.
        density_components, appearance_components: channels ``C`` of the lines (96 and 288 in TensoRF).
        scale: standard deviation of the initial values (0.2 in TensoRF's program).
        generator: for the initial values, of the networks too.
        options: of `TensorialField`.

    Example:
        >>> field = CPField(torch.tensor([[-1.0] * 3, [1.0] * 3]), (8, 9, 10))
        >>> [tuple(line.shape) for line in field.density_lines]
        [(10, 96), (9, 96), (8, 96)]
    """

    def __init__(
        self,
        bounds: Tensor,
        resolution: tuple[int, int, int],
        *,
        density_components: int = 96,
        appearance_components: int = 288,
        scale: float = 0.2,
        generator: torch.Generator | None = None,
        **options: Any,
    ) -> None:
        super().__init__(bounds, resolution, appearance_components, generator=generator, **options)
        self.density_lines = _lines(resolution, density_components, scale, generator)
        self.appearance_lines = _lines(resolution, appearance_components, scale, generator)

    def density_features(self, u: Tensor) -> Tensor:
        """``G(x)``: normalised positions ``(N, 3)`` to ``(N,)``."""
        return ops.cp_density(u, list(self.density_lines), _open_components(self.density_lines))

    def appearance_features(self, u: Tensor) -> Tensor:
        """Normalised positions ``(N, 3)`` to the products of the components ``(N, C)``."""
        return ops.cp_features(u, list(self.appearance_lines), _open_components(self.appearance_lines))

    def _marched(
        self, march: ops.MarchArguments, activation: ops.Activation, transmittance_bound: float
    ) -> ops.RayMarchResult:
        opened = _open_components(self.density_lines)
        return ops.cp_march_density(march, activation, transmittance_bound, list(self.density_lines), opened)

    @torch.no_grad()
    def resample(self, resolution: tuple[int, int, int]) -> None:
        """Replace every line by its linear interpolation at new nodes (`upsample_volume_grid`); the ends stay."""
        for lines in (self.density_lines, self.appearance_lines):
            for k, axis in enumerate(LINE_AXES):
                lines[k] = nn.Parameter(resampled(lines[k], (resolution[axis],)))
        self.resolution = resolution

    @torch.no_grad()
    def _crop(self, start: list[int], stop: list[int]) -> None:
        for lines in (self.density_lines, self.appearance_lines):
            for k, axis in enumerate(LINE_AXES):
                lines[k] = nn.Parameter(lines[k][start[axis] : stop[axis]].clone())

    def sites(self) -> dict[str, Site]:
        """``density`` and ``appearance``, each also as ``.lines``; encodings.

        A mask acts on the first line alone: on all three, a fractional value would enter as its cube.
        """
        found = super().sites()
        for kind in ("density", "appearance"):
            site = Site(
                mask=parameters(f"{kind}_lines.0", dim=-1, spatial=(0,)),
                grids=parameters(f"{kind}_lines.*", dim=-1, spatial=(0,)),
            )
            found[kind] = found[f"{kind}.lines"] = site
        return found


def _lines(
    resolution: tuple[int, int, int], channels: int, scale: float, generator: torch.Generator | None
) -> nn.ParameterList:
    if channels < 1:
        raise ValueError(f"components: found {channels}, expected at least 1")
    return nn.ParameterList(
        nn.Parameter(scale * torch.randn(resolution[axis], channels, generator=generator))
        for axis in LINE_AXES
    )


def _open_components(lines: nn.ParameterList) -> int | None:
    """Components to read: a component whose factor is closed on any axis is 0."""
    closed = [c for k in range(3) if (c := open_channels(lines, str(k))) is not None]
    return min(closed) if closed else None
