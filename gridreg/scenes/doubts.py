"""Notes on what makes a score, or a place in the world, mean less than it seems."""

from __future__ import annotations

import torch
from torch import Tensor

from gridreg.scenes.views import IN_PLACE, Views, World


def trained_on(views: Views, train: Views) -> Tensor:
    """Return which views show what a training view shows, from the same place, ``(V,)`` bool."""
    found = torch.zeros(len(views), dtype=torch.bool)
    for number, pose in enumerate(views.poses):
        same = (train.poses == pose).flatten(1).all(dim=1).nonzero().flatten().tolist()
        found[number] = any(torch.equal(train.pixels[i], views.pixels[number]) for i in same)
    return found


def doubts(world: World, train: Views, test: Views) -> list[str]:
    """Return what makes a score, or a place in the world, mean less than it seems."""
    notes = []
    if world != IN_PLACE:
        place = ", ".join(f"{value:.6g}" for value in world.origin)
        notes.append(
            f"the world is centred on ({place}) and scaled: its unit is now {world.unit:.4g} of the files'"
        )
    fitted = int(trained_on(test, train).sum())
    if fitted:
        notes.append(
            f"{fitted} of {len(test)} test views are trained on: a score on them tells how well they are fitted, "
            "not what another view would be like"
        )
    for what, views in (("training", train), ("test", test)):
        names = views.plain
        if names:
            notes.append(
                f"{len(names)} of {len(views)} {what} images show nothing but one colour ({names[0]}, ...): "
                "a high score on them means nothing"
            )
    return notes
