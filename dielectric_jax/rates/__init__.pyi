from .events import delay, peak_pressure, snap_voltage
from .following import bounds, follow
from .protocols import AbstractProtocol, Hold, Ramp, Steps, Triangle
from .runs import Run, RunEvent, Snap, estimate_errors
from .slow_passage import SlowPassage, slow_passage

__all__ = [
    "AbstractProtocol",
    "Hold",
    "Ramp",
    "Run",
    "RunEvent",
    "SlowPassage",
    "Snap",
    "Steps",
    "Triangle",
    "bounds",
    "delay",
    "estimate_errors",
    "follow",
    "peak_pressure",
    "slow_passage",
    "snap_voltage",
]
