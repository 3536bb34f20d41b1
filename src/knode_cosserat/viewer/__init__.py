"""Viewer of robots in three dimensions in a browser: trajectories, and live robots.

The page is drawn by three.js and its plots by uPlot (both MIT), which come with this package and are 0.8 MB
together; nothing is loaded from anywhere. Viser and Rerun were the alternatives. Viser's scenes need its
server, or its own large client beside the file; Rerun's files need its viewer, and its web viewer is an
order of magnitude larger than this one. Neither has sliders, plots and a clock that one file can hold and
open from a disk. The page has no build step: the browser runs the files in `page/` directly.

Trajectories need no further package. The live mode needs `websockets`, of the extra `viz`.
"""

from knode_cosserat.viewer.closed_loop import control_live
from knode_cosserat.viewer.live import view_live
from knode_cosserat.viewer.pages import export_scene, view

__all__ = ["control_live", "export_scene", "view", "view_live"]
