"""Write docs/photographs/*.jpg, the images of photographs.md, from the built-in photographs.

python -m gridreg reconstruct builtin OUT
python docs/make_photographs.py OUT          with Chromium, for the page

Each is at most 100 KB.
"""

from __future__ import annotations

import argparse
import io
import shutil
import subprocess
import tempfile
from pathlib import Path

from PIL import Image, ImageOps

from gridreg.cli.runs import photographs_of
from gridreg.errors import InputError
from gridreg.scenes.board import board_image, get_board
from gridreg.training.files import write_bytes

FOLDER = Path(__file__).with_name("photographs")
LARGEST = 100_000
_CHROMIUM = ("chromium", "chromium-browser", "google-chrome")


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


def screenshot(page: Path, width: int = 420, height: int = 860) -> Image.Image:
    """Return what a telephone shows of a page.

    Raises:
        InputError: without Chromium.
    """
    program = next((found for name in _CHROMIUM if (found := shutil.which(name))), None)
    if program is None:
        raise InputError(f"{page}: needs one of {', '.join(_CHROMIUM)} to be drawn")
    with tempfile.TemporaryDirectory() as scratch:
        shot = Path(scratch) / "shot.png"
        options = ["--headless", "--no-sandbox", "--disable-quic", "--no-first-run"]
        options += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
        options += [
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
            "--virtual-time-budget=8000",
            f"--user-data-dir={scratch}/user",
        ]
        command = [
            program,
            *options,
            f"--window-size={width},{height}",
            f"--screenshot={shot}",
            page.resolve().as_uri(),
        ]
        subprocess.run(command, check=True, capture_output=True, timeout=120)
        return Image.open(shot).convert("RGB")


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
        "page": screenshot(out / "index.html"),
    }
    FOLDER.mkdir(exist_ok=True)
    for name, image in images.items():
        image.thumbnail((1000, 860))
        write_bytes(FOLDER / f"{name}.jpg", as_jpeg(image))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
