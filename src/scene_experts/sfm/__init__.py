"""Photographs or a video to a capture: poses and points by structure from motion (COLMAP, through pycolmap)."""
