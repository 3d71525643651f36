"""What every extracted mesh must be."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from gridreg.export.mesh import Mesh


def radii(mesh: Mesh) -> NDArray[np.float64]:
    return np.linalg.norm(mesh.vertices, axis=1)


def assert_closed(mesh: Mesh) -> None:
    assert mesh.watertight
    assert mesh.volume > 0
    # An implementation of our own would not notice its own mistakes.
    other = mesh.to_trimesh()
    assert other.is_watertight
    assert other.is_winding_consistent
    assert other.volume == pytest.approx(mesh.volume)
