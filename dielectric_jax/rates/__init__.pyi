from .events import delay, peak_pressure, snap_voltage
from .films import FilmEvent, FilmRun, PullIn, film_stress, follow_film, pull_in, vhb_hossain_2012
from .following import bounds, follow
from .passage_laws import SlowPassage, slow_passage
from .protocols import AbstractProtocol, Hold, Ramp, Steps, Triangle
from .runs import Run, RunEvent, Snap, converted, estimate_errors
from .sweeping import InTime, RunOutcome, TimeRegime, regime_in_time

__all__ = [
    "AbstractProtocol",
    "FilmEvent",
    "FilmRun",
    "Hold",
    "InTime",
    "PullIn",
    "Ramp",
    "Run",
    "RunEvent",
    "RunOutcome",
    "SlowPassage",
    "Snap",
    "Steps",
    "TimeRegime",
    "Triangle",
    "bounds",
    "converted",
    "delay",
    "estimate_errors",
    "film_stress",
    "follow",
    "follow_film",
    "peak_pressure",
    "pull_in",
    "regime_in_time",
    "slow_passage",
    "snap_voltage",
    "vhb_hossain_2012",
]
