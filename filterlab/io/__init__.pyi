from .affines import CONVENTIONS, load_affine
from .atomic import atomic_write
from .bounded import VolumeFileError, VolumeHeader
from .config import ConfigError, StrictModel, dump_config, load_config
from .covers import is_slim, load_slim, save_slim
from .heights import HEIGHT_FORMATS, describe_heights, load_heights, save_heights
from .images import load_image, save_animation, save_image
from .meshes import MESH_FORMATS, load_mesh, save_mesh
from .molecules import load_molecule
from .points import load_points
from .quadric_files import is_quadrics, load_quadrics, save_quadrics
from .volumes import FORMATS, describe, load_volume, save_volume

__all__ = [
    "CONVENTIONS",
    "FORMATS",
    "HEIGHT_FORMATS",
    "MESH_FORMATS",
    "ConfigError",
    "StrictModel",
    "VolumeFileError",
    "VolumeHeader",
    "atomic_write",
    "describe",
    "describe_heights",
    "dump_config",
    "is_quadrics",
    "is_slim",
    "load_affine",
    "load_config",
    "load_heights",
    "load_image",
    "load_mesh",
    "load_molecule",
    "load_points",
    "load_quadrics",
    "load_slim",
    "load_volume",
    "save_animation",
    "save_heights",
    "save_image",
    "save_mesh",
    "save_quadrics",
    "save_slim",
    "save_volume",
]
