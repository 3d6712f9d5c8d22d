"""Fixtures for the tests of the viewer in a browser."""

from support.viewers import capture, serving, viewer  # noqa: F401
