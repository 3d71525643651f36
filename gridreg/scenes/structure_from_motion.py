"""Cameras of images by pycolmap, as a program of its own: ``python structure_from_motion.py IMAGES OUT``.

It runs apart from the rest because pycolmap brings image libraries along that clash with Pillow's inside one
process (memory is corrupted), and because native code that aborts must not take the caller with it. So it
imports nothing of gridreg, and is started by its path.
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path
from typing import Any

# Fraction of the images above which a second attempt is not worth its time.
_ENOUGH = 0.9
# Of adjusting and finding points anew: on the images of benchmarks/own_photographs.py a third changes
# nothing any more.
_ROUNDS = 2

STAGES = ("features", "matches", "cameras")
"""Lines that the program prints while it works, ``placed N`` beside them, before ``registered N``."""


def reconstruct(images: Path, out: Path) -> int:
    """Write the largest model that pycolmap finds to ``out/model`` and return how many images are in it.

    The images of a folder share one camera, since they have one size; its lens is found along with the poses.
    """
    import pycolmap

    pycolmap.set_random_seed(0)
    enough = _ENOUGH * sum(1 for path in images.rglob("*") if path.is_file())
    best = None
    for options in (_few_features(), pycolmap.FeatureExtractionOptions()):
        place = out / f"features_{options.sift.max_num_features}"
        place.mkdir()
        best = _larger(best, _model(images, place, options, enough))
        if best is not None and best.num_reg_images() >= enough:
            break
    if best is None:
        return 0
    (out / "model").mkdir()
    best.write_binary(str(out / "model"))
    return int(best.num_reg_images())


def _few_features() -> Any:
    """Options that take a third of the time and place the images of most sets; the others need all features."""
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = 1280
    options.sift.max_num_features = 3072
    # Images are not enlarged to find the smallest features.
    options.sift.first_octave = 0
    return options


def _model(images: Path, out: Path, options: Any, enough: float) -> Any:
    """The ``pycolmap.Reconstruction`` with the most images from features of these options, or None."""
    import pycolmap

    database = out / "database.db"
    print(STAGES[0], flush=True)
    pycolmap.extract_features(
        database, images, camera_mode=pycolmap.CameraMode.PER_FOLDER, extraction_options=options
    )
    print(STAGES[1], flush=True)
    pycolmap.match_exhaustive(database)
    print(STAGES[2], flush=True)
    # A lens that is adjusted from the first pair on can collapse to a wide angle when cameras stand in a
    # circle. So it stays as EXIF data say (or as most lenses are) until all images have their places.
    best = _largest_model(database, images, out / "kept_lens", adjust_lens=False)
    if best is not None:
        best = _refined(best, database, images, out)
    if best is None or best.num_reg_images() < enough:
        best = _larger(best, _largest_model(database, images, out / "free_lens", adjust_lens=True))
    return best


def _larger(*models: Any) -> Any:
    """The one of several models with the most images, the first of equals; each may be None."""
    found = (model for model in models if model is not None)
    return max(found, key=lambda model: model.num_reg_images(), default=None)


def _refined(model: Any, database: Path, images: Path, out: Path) -> Any:
    """Adjust poses and lens together, then find the points anew: what was an outlier before may fit now."""
    import pycolmap

    pycolmap.bundle_adjustment(model, pycolmap.BundleAdjustmentOptions())
    for turn in range(_ROUNDS):
        folder = out / f"refined_{turn}"
        folder.mkdir()
        model = pycolmap.triangulate_points(
            model, database, images, folder, clear_points=True, refine_intrinsics=True
        )
        pycolmap.bundle_adjustment(model, pycolmap.BundleAdjustmentOptions())
    return model


def _largest_model(database: Path, images: Path, out: Path, *, adjust_lens: bool) -> Any:
    """The ``pycolmap.Reconstruction`` with the most images, or None."""
    import pycolmap

    out.mkdir()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    options.mapper.random_seed = 0
    options.ba_refine_focal_length = adjust_lens
    options.ba_refine_extra_params = adjust_lens
    placed = itertools.count(3)
    models = pycolmap.incremental_mapping(
        database, images, out, options, next_image_callback=lambda: print("placed", next(placed), flush=True)
    )
    return _larger(*models.values())


if __name__ == "__main__":
    print("registered", reconstruct(Path(sys.argv[1]), Path(sys.argv[2])), flush=True)
