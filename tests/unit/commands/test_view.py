"""`scene-experts view` from its flags."""

import sys

import pytest

from scene_experts.commands import view as command
from scene_experts.core.errors import InputError
from support.messages import naming


def test_without_viser_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install .viser"):
        command.view(["run"])


def test_a_port_that_is_none_is_refused(tmp_path):
    with pytest.raises(InputError, match="--port"):
        command.view([str(tmp_path), "--port", "99999"])


@pytest.mark.parametrize("host", ["nope.invalid", "203.0.113.1", "300.1.1.1", "x" * 70])
def test_an_address_of_another_machine_is_refused(host, tmp_path):
    with pytest.raises(InputError, match=f"--host.*{host}"):
        command.view([str(tmp_path), "--host", host])


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    pytest.importorskip("viser")
    with pytest.raises(InputError, match=naming(tmp_path)):
        command.view([str(tmp_path)])
