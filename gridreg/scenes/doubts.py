"""Notes on what makes a score, or a place in the world, mean less than it seems."""

from __future__ import annotations

import torch

from gridreg.scenes.views import IN_PLACE, Views, World


def trained_on(views: Views, train: Views) -> int:
    """Return how many views show what a training view shows, from the same place."""
    count = 0
    # The views to score stay where they are when a scene goes to another device.
    poses = train.poses.to(views.poses.device)
    for pose, pixels in zip(views.poses, views.pixels, strict=True):
        same = (poses == pose).flatten(1).all(dim=1).nonzero().flatten().tolist()
        count += any(torch.equal(train.pixels[i].to(pixels.device), pixels) for i in same)
    return count


def doubts(world: World, train: Views, test: Views) -> list[str]:
    """Return what makes a score, or a place in the world, mean less than it seems."""
    notes = []
    if world != IN_PLACE:
        place = ", ".join(f"{value:.6g}" for value in world.origin)
        notes.append(
            f"the world is centred on ({place}) and scaled: its unit is now {world.unit:.4g} of the files'"
        )
    fitted = trained_on(test, train)
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
