"""Write docs/photographs/*.jpg, the images of photographs.md, from the built-in photographs.

python -m gridreg reconstruct builtin OUT
python docs/make_photographs.py OUT          with Chromium, for the page

Each is at most 100 KB.
"""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path

from PIL import Image, ImageOps

sys.path.insert(0, str(Path(__file__).resolve().parent))
from make_images import photographed

from gridreg.cli.runs import photographs_of
from gridreg.scenes.board import board_image, get_board
from gridreg.training.files import write_bytes

FOLDER = Path(__file__).with_name("photographs")
LARGEST = 100_000


def contact_sheet(photographs: Path, width: int = 900, columns: int = 4) -> Image.Image:
    """Return the photographs of a folder, upright and small, side by side."""
    paths = sorted(photographs.iterdir())
    cell = width // columns
    sheet = Image.new("RGB", (width, cell * -(-len(paths) // columns)), "white")
    for k, path in enumerate(paths):
        with Image.open(path) as image:
            small = ImageOps.exif_transpose(image)
            small.thumbnail((cell - 8, cell - 8))
        x, y = cell * (k % columns), cell * (k // columns)
        sheet.paste(small, (x + (cell - small.width) // 2, y + (cell - small.height) // 2))
    return sheet


def as_jpeg(image: Image.Image) -> bytes:
    """Return an image as JPEG, as good as fits into `LARGEST`."""
    for quality in (85, 75, 60, 45):
        file = io.BytesIO()
        image.convert("RGB").save(file, "JPEG", quality=quality)
        if file.tell() <= LARGEST:
            break
    return file.getvalue()


def main() -> int:
    """Write the images and return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="what `gridreg reconstruct builtin OUT` made")
    out = parser.parse_args().out
    sheet = Image.fromarray(board_image(get_board("a4"), 2))
    images = {
        "sheet": ImageOps.expand(sheet, 2, "grey"),
        "taken": contact_sheet(photographs_of(Path("builtin"))),
        "cameras": Image.open(out / "scene/cameras.png"),
        "masks": Image.open(out / "scene/masks.jpg"),
        "page": Image.fromarray(photographed((out / "index.html").resolve().as_uri(), (420, 860), "true")),
    }
    FOLDER.mkdir(exist_ok=True)
    for name, image in images.items():
        image.thumbnail((1000, 860))
        write_bytes(FOLDER / f"{name}.jpg", as_jpeg(image))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
