"""Tracking of points through the frames of a video."""

from .pipeline import TrackingReport, point_candidates, track, track_frames
from .tracker import Tracker, TrackingOptions
from .tracks import TrackedFrame, load_tracks
from .video import Frame, FrameSource

__all__ = [
    "Frame",
    "FrameSource",
    "TrackedFrame",
    "Tracker",
    "TrackingOptions",
    "TrackingReport",
    "load_tracks",
    "point_candidates",
    "track",
    "track_frames",
]
