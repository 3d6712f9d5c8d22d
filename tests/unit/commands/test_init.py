"""The table of commands. The commands as a whole are in test_cli.py."""

from importlib import import_module

from scene_experts import cli, commands


def test_every_command_of_the_help_has_a_handler():
    assert commands.HANDLERS.keys() == cli.COMMANDS.keys()
    for module, function in commands.HANDLERS.values():
        assert callable(getattr(import_module(f"scene_experts.commands.{module}"), function))
