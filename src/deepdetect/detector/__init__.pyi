from .detector import DeepDetect as DeepDetect
from .heatmap import HeatmapOptions as HeatmapOptions
from .point_detector import PointDetector as PointDetector
