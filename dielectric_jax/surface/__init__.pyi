from .family import SurfaceFamily
from .files import fingerprint
from .resolution import ROWS
from .rows import Conditions, Rows, crossings, rows_of
from .surface import ById, Surface, SurfaceState, check_tolerance, pressure_and_volume

__all__ = [
    "ROWS",
    "ById",
    "Conditions",
    "Rows",
    "Surface",
    "SurfaceFamily",
    "SurfaceState",
    "check_tolerance",
    "crossings",
    "fingerprint",
    "pressure_and_volume",
    "rows_of",
]
