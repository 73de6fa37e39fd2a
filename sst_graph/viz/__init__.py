"""Pictures for people: the LiDAR drawn into the camera image."""

from sst_graph.viz.overlay import Placement, draw_overlay, draw_placement, stacked

__all__ = ["Placement", "draw_overlay", "draw_placement", "stacked"]
