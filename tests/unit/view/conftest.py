"""Fixtures for the tests of the viewer."""

from support.viewers import capture, serving, viewer  # noqa: F401
