"""What leaves the program: meshes, films, and a look at the field in a browser."""

from gridreg.export.mesh import Mesh, extract_mesh, read_mesh, save_mesh, write_mesh

__all__ = ["Mesh", "extract_mesh", "read_mesh", "save_mesh", "write_mesh"]
