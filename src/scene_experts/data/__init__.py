"""Captures: photographs, cameras and points, from the files of the usual tools to what training reads."""

from scene_experts.data.capture import load
from scene_experts.data.views import Capture, Frame, View, World

__all__ = ["Capture", "Frame", "View", "World", "load"]
