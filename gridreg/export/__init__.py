"""Meshes, videos, and a look at the field in a browser."""

from gridreg.export.camera_files import load_cameras, save_cameras
from gridreg.export.camera_paths import CAMERA_PATHS, camera_path, spiral, sway, tour, turntable
from gridreg.export.cameras import Orbit, look_at, orbit_of_box, orbit_of_views
from gridreg.export.compare import MeshComparison, compare_meshes
from gridreg.export.images import MODES, to_image
from gridreg.export.mesh import Mesh, extract_mesh
from gridreg.export.mesh_files import read_mesh, save_mesh, write_mesh
from gridreg.export.next_view import NextView, next_view
from gridreg.export.page import write_page
from gridreg.export.runs import (
    LiveView,
    check_drawing,
    draw_run,
    live_view,
    video_path,
)
from gridreg.export.video import render_frames, render_video
from gridreg.export.viewer import Viewer
from gridreg.rendering.cameras import Camera, Lens
from gridreg.rendering.model import Model

__all__ = [
    "CAMERA_PATHS",
    "MODES",
    "Camera",
    "Lens",
    "LiveView",
    "Mesh",
    "MeshComparison",
    "Model",
    "NextView",
    "Orbit",
    "Viewer",
    "camera_path",
    "check_drawing",
    "compare_meshes",
    "draw_run",
    "extract_mesh",
    "video_path",
    "live_view",
    "load_cameras",
    "look_at",
    "next_view",
    "orbit_of_box",
    "orbit_of_views",
    "to_image",
    "read_mesh",
    "render_frames",
    "render_video",
    "save_cameras",
    "save_mesh",
    "spiral",
    "sway",
    "tour",
    "turntable",
    "write_mesh",
    "write_page",
]
