"""Turns photographs or a video into a capture: camera poses and points by structure from motion
(COLMAP through pycolmap)."""
