"""Exposure and white balance of photographs, estimated beside the field."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from gridreg.rendering import Rendered
from gridreg.scenes import Scene
from gridreg.training.metrics import psnr
from gridreg.training.rays import RayBank
from gridreg.training.settings import TrainSettings

AFFINE_CONVENTION = {
    "psnr_affine": "dB; psnr after the affine map of colours that fits each image best to its target"
}
"""Meaning of the score that runs with exposures have besides, for ``metrics.json``."""

# Before a fraction of the run, colours of a young field would be taken for exposures.
_RATE, _WEIGHT, _FROM = 0.02, 1e-3, 0.25


def wants_exposure(scene: Scene, settings: TrainSettings) -> bool:
    """Whether gains are estimated: where ``train.exposure`` says so and there are photographs to compare."""
    return settings.exposure and len(scene.train) > 1


class Exposure:
    """A gain of each colour channel for each photograph; their logarithms have mean 0, so that renders are the mean.

    Args:
        views: number of photographs.
        steps: of the run; the learning rate falls to 0 along it.
        device: of the rays.

    Source: the affine colour of each image of Urban Radiance Fields (Rematas et al. 2022), its diagonal alone.
    """

    def __init__(self, views: int, steps: int, device: torch.device | str = "cpu") -> None:
        self.log_gains = nn.Parameter(torch.zeros(views, 3, device=device))
        self._steps = steps
        self.optimizer = torch.optim.Adam([self.log_gains], lr=_RATE, betas=(0.9, 0.99))

    @property
    def gains(self) -> Tensor:
        """``(V, 3)``, as photographed over as rendered."""
        return (self.log_gains - self.log_gains.mean(dim=0)).exp()

    def expose(self, rendered: Rendered, bank: RayBank, taken: bool) -> Rendered:
        """Pixels as photographs show them, of the rays that the bank drew last; others behind them stay.

        Args:
            rendered: those rays first.
            bank: that they were drawn from.
            taken: whether what is behind the field is in the photographs; a background that was put there is not
                exposed, unless its pixel may show the paper that the object stands on.
        """
        count = len(bank.drawn)
        gains, colour = self.gains[bank.drawn_views], rendered.colour[:count]
        exposed = gains * colour
        if not taken and rendered.samples is not None and rendered.samples.background is not None:
            put = ~bank.pixels[bank.drawn, 3:].isnan() * (1 - rendered.opacity[:count])[:, None]
            exposed = exposed + (1 - gains) * put * rendered.samples.background[:count]
        return replace(rendered, colour=torch.cat([exposed, rendered.colour[count:]]))

    def step(self, step: int) -> None:
        """Update from the gradients of iteration ``step``."""
        if step >= _FROM * self._steps and self.log_gains.grad is not None:
            # Nothing is a matter of exposure that need not be.
            even = self.log_gains.detach() - self.log_gains.detach().mean(dim=0)
            self.log_gains.grad += 2 * _WEIGHT / even.numel() * even
            for group in self.optimizer.param_groups:
                group["lr"] = _RATE * (1 - step / self._steps)
            self.optimizer.step()
        self.optimizer.zero_grad()

    def state_dict(self) -> dict[str, Any]:
        """All that a later process needs to go on."""
        return {"log_gains": self.log_gains.detach(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state_dict`."""
        with torch.no_grad():
            self.log_gains.copy_(state["log_gains"])
        self.optimizer.load_state_dict(state["optimizer"])


def affine_corrected(image: Tensor, target: Tensor) -> Tensor:
    """An image ``(H, W, 3)`` after the affine map of colours that takes it closest to its target.

    Exposure and white balance of a photograph that was not trained on are nobody's guess; a score after this correction
    leaves them out. Source: NeRF in the Wild (Martin-Brualla et al. 2021) fits an appearance to half of each test
    image; the least-squares map, with 12 numbers, is the common simpler form.

    Example:
        >>> image = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0))
        >>> found = affine_corrected(image, 0.5 * image + 0.1)
        >>> float((found - 0.5 * image - 0.1).abs().max()) < 1e-6
        True
    """
    flat = image.reshape(-1, 3).double()
    known = torch.cat([flat, torch.ones_like(flat[:, :1])], dim=1)
    # By normal equations, which are 4 x 4: an image of one colour has no unique map, and gets the smallest.
    solution = torch.linalg.pinv(known.T @ known) @ (known.T @ target.reshape(-1, 3).double())
    corrected: Tensor = known @ solution
    return corrected.to(image).reshape(image.shape)


def affine_psnr(image: Tensor, target: Tensor) -> float:
    """PSNR (dB) of an image ``(H, W, 3)`` after `affine_corrected`."""
    return psnr(affine_corrected(image, target), target)
