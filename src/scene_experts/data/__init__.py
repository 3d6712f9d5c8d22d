"""Captures: photographs, cameras and points, from the files of common tools to what training
reads."""
