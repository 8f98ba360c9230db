from .films import FilmEvent, FilmRun, PullIn, film_stress, follow_film, pull_in, vhb_hossain_2012
from .following import bounds, follow
from .protocols import AbstractProtocol, Hold, Ramp, Steps, Triangle
from .runs import Run, RunEvent, Snap

__all__ = [
    "AbstractProtocol",
    "FilmEvent",
    "FilmRun",
    "Hold",
    "PullIn",
    "Ramp",
    "Run",
    "RunEvent",
    "Snap",
    "Steps",
    "Triangle",
    "bounds",
    "film_stress",
    "follow",
    "follow_film",
    "pull_in",
    "vhb_hossain_2012",
]
