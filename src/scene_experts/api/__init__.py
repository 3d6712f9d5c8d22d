"""The public Python API. `import scene_experts` offers its names; import them from there."""
