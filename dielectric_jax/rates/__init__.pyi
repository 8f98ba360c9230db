from .following import bounds, follow
from .protocols import AbstractProtocol, Hold, Ramp, Steps, Triangle
from .runs import Run, RunEvent, Snap, estimate_errors

__all__ = [
    "AbstractProtocol",
    "Hold",
    "Ramp",
    "Run",
    "RunEvent",
    "Snap",
    "Steps",
    "Triangle",
    "bounds",
    "estimate_errors",
    "follow",
]
