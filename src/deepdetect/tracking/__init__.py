"""Video: points followed from frame to frame, and the path of the camera."""

from .frames import Frame, FrameSource
from .odometry import OdometryOptions, VisualOdometry
from .pipeline import TrackingReport, point_candidates, track, track_frames
from .tracker import Tracker, TrackingOptions
from .tracks import TrackedFrame, load_tracks, save_tracks
from .trajectory import Trajectory, load_poses, save_poses

__all__ = [
    "Frame",
    "FrameSource",
    "OdometryOptions",
    "TrackedFrame",
    "Tracker",
    "TrackingOptions",
    "TrackingReport",
    "Trajectory",
    "VisualOdometry",
    "load_poses",
    "load_tracks",
    "point_candidates",
    "save_poses",
    "save_tracks",
    "track",
    "track_frames",
]
