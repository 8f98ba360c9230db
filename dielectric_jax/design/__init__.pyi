from .area_strain import Design, maximise_area_strain
from .calibration import Calibration, calibrate
from .designs import Designs, classify_designs, surface_for
from .film_calibration import FilmCalibration, calibrate_film
from .measurements import FilmMeasurement, Measurement, read_film_measurement, read_measurement
from .objectives import Optimum, maximise
from .regime_maps import Boundary, RegimeEdge, RegimeMap, regime_edges, regime_map

__all__ = [
    "Boundary",
    "Calibration",
    "Design",
    "Designs",
    "FilmCalibration",
    "FilmMeasurement",
    "Measurement",
    "Optimum",
    "RegimeEdge",
    "RegimeMap",
    "calibrate",
    "calibrate_film",
    "classify_designs",
    "maximise",
    "maximise_area_strain",
    "read_film_measurement",
    "read_measurement",
    "regime_edges",
    "regime_map",
    "surface_for",
]
