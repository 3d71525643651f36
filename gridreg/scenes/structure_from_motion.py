"""Cameras of pictures by pycolmap, as a program of its own: ``python structure_from_motion.py PICTURES OUT``.

It runs apart from the rest because pycolmap brings image libraries along that clash with Pillow's inside one
process (memory is corrupted), and because native code that aborts must not take the caller with it. So it
imports nothing of gridreg, and is started by its path.
"""

from __future__ import annotations

import sys
from pathlib import Path

STAGES = ("features", "matches", "cameras")
"""Lines that the program prints while it works, before ``registered N``."""


def reconstruct(pictures: Path, out: Path) -> int:
    """Write the largest model that pycolmap finds to ``out/model`` and return how many pictures are in it.

    All pictures share one camera, since they have one size; its lens is found along with the poses.
    """
    import pycolmap

    pycolmap.set_random_seed(0)
    database = out / "database.db"
    print(STAGES[0], flush=True)
    pycolmap.extract_features(database, pictures, camera_mode=pycolmap.CameraMode.SINGLE)
    print(STAGES[1], flush=True)
    pycolmap.match_exhaustive(database)
    print(STAGES[2], flush=True)
    (out / "models").mkdir()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    options.mapper.random_seed = 0
    models = pycolmap.incremental_mapping(database, pictures, out / "models", options)
    if not models:
        return 0
    largest = max(models.values(), key=lambda model: model.num_reg_images())
    (out / "model").mkdir()
    largest.write_binary(str(out / "model"))
    return int(largest.num_reg_images())


if __name__ == "__main__":
    print("registered", reconstruct(Path(sys.argv[1]), Path(sys.argv[2])), flush=True)
