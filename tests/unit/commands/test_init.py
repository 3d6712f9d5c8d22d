"""The table of commands. The commands as a whole are in tests/system/test_cli.py."""

from importlib import import_module

from scene_experts import commands


def test_every_command_has_its_function():
    for place, text in commands.COMMANDS.values():
        module, _, function = place.partition(":")
        assert callable(getattr(import_module(f"scene_experts.commands.{module}"), function)) and text
