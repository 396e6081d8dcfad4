"""Where free cameras stand: those of the Fetch tasks, in which block and goal are well visible at 96 x 96 pixels."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class CameraPose:
    """A camera that looks at a point, in MuJoCo's terms.

    Attributes:
        distance: from the point, meters.
        lookat: the point, meters.
        azimuth: degrees; 180 looks along -x, 90 along +y.
        elevation: degrees; -90 looks straight down.
    """

    distance: float
    lookat: tuple[float, float, float]
    azimuth: float
    elevation: float


FETCH_POSE = CameraPose(distance=0.95, lookat=(1.33, 0.75, 0.6), azimuth=150.0, elevation=-30.0)
"""Over the table's corner. The block's edge is 6 pixels long at 96 x 96, the goal 5 pixels across: twice as long as with
the stock camera. The farthest starts and goals are just inside the image."""

FETCH_POSES: Mapping[str, CameraPose] = {
    "front": CameraPose(distance=0.85, lookat=(1.33, 0.75, 0.61), azimuth=180.0, elevation=-30.0),
    "side": CameraPose(distance=0.8, lookat=(1.33, 0.75, 0.6), azimuth=90.0, elevation=-15.0),
}
"""Two cameras at right angles: one image alone does not say how far away a goal in the air is."""

SLIDE_POSE = CameraPose(distance=1.6, lookat=(1.45, 0.75, 0.5), azimuth=150.0, elevation=-35.0)
SLIDE_POSES: Mapping[str, CameraPose] = {
    "front": CameraPose(distance=1.7, lookat=(1.45, 0.75, 0.5), azimuth=180.0, elevation=-35.0),
    "side": CameraPose(distance=1.6, lookat=(1.45, 0.75, 0.5), azimuth=90.0, elevation=-35.0),
}
"""The same for FetchSlide, whose table is longer."""
