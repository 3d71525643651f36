"""Images of several sizes, portrait beside landscape, cut to one around what all cameras look at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gridreg.scenes.decoding import open_image
from gridreg.scenes.extent import focus_point
from gridreg.scenes.frames import Frame

__all__ = ["crop_to_one_size"]

# Of a crop, in edges of what the masks keep; and the least one, pixels.
_MARGIN, _LEAST = 1.2, 32


def crop_to_one_size(
    frames: Sequence[Frame], scene: Path, sizes: Mapping[str, tuple[int, int]], *, to_masks: bool = False
) -> tuple[list[Frame], tuple[int, int]]:
    """Bring images and masks of a scene folder to one size, in place, and return frames with their cameras there.

    Images are reduced until their shorter edges are the same, and cut to what they have in common, with the point that
    all optical axes come closest to as near to the middle as it may be.

    Args:
        frames: the frames.
        scene: the folder.
        sizes: width and height of the images by the path that their frames state.
        to_masks: cut closer, to what the masks keep and a margin, with that in the middle: the object of a photograph
            of many pixels keeps them when it is reduced.
    """
    short = min(min(sizes[frame.file_path]) for frame in frames)
    scaled = [short / min(sizes[frame.file_path]) * np.array(sizes[frame.file_path]) for frame in frames]
    new = np.floor(np.min(scaled, axis=0) + 1e-6)
    focus = focus_point(np.stack([frame.pose for frame in frames]))
    kept = [_box_of_mask(scene / str(frame.mask_path)) if to_masks else None for frame in frames]
    if to_masks:
        edges = [
            0 if box is None else (box[1] - box[0]).max() * size[0] / sizes[frame.file_path][0]
            for frame, box, size in zip(frames, kept, scaled, strict=True)
        ]
        new = np.minimum(new, max(_LEAST, np.ceil(_MARGIN * max(edges))))
    made = []
    for frame, size, mask in zip(frames, scaled, kept, strict=True):
        original = np.array(sizes[frame.file_path])
        scale = float(size[0] / original[0])
        fx, fy, cx, cy = frame.camera.intrinsics(*sizes[frame.file_path])
        x, y, z = (focus - frame.pose[:3, 3]) @ frame.pose[:3, :3]
        middle = np.array([cx - fx * x / z, cy + fy * y / z]) if z < 0 else original / 2
        if mask is not None:
            middle = mask.mean(axis=0)
        # Whole pixels: what is not reduced is not resampled either.
        start = np.clip(np.round(middle - new / scale / 2), 0, original - new / scale)
        box = (*start, *(start + new / scale))
        for name in (frame.file_path, frame.mask_path):
            if name is not None:
                with open_image(scene / name) as image:
                    cut = image.resize((int(new[0]), int(new[1])), Image.Resampling.BOX, box=box)
                    cut.save(scene / name, quality=95)
        camera = replace(
            frame.camera,
            angle_x=None,
            fx=fx * scale,
            fy=fy * scale,
            cx=float(cx - start[0]) * scale,
            cy=float(cy - start[1]) * scale,
            width=int(new[0]),
            height=int(new[1]),
        )
        made.append(replace(frame, camera=camera))
    return made, (int(new[0]), int(new[1]))


def _box_of_mask(path: Path) -> NDArray[np.float64] | None:
    """Return ``(2, 2)`` left upper and right lower corner of what a mask keeps, pixels; None where it keeps nothing."""
    with open_image(path) as image:
        box = image.convert("L").point(lambda value: 255 * (value > 127)).getbbox()
    return None if box is None else np.array(box, dtype=np.float64).reshape(2, 2)
