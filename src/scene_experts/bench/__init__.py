"""Measure the speed of this machine, each time against a named peer, in about a minute
(`scene-experts bench`)."""
