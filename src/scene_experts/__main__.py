from scene_experts.cli import entry

entry()
