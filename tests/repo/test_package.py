"""The files around the code: one version, extras that exist, workflows whose commands exist."""

import re
import tomllib
from importlib import metadata

import yaml

import scene_experts
from support.places import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
FLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def test_the_version_is_in_one_place():
    assert "version" not in PROJECT and PROJECT["dynamic"] == ["version"]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert cited["version"] == scene_experts.__version__ and cited["license"] == PROJECT["license"]
    assert f"## {scene_experts.__version__}" in (ROOT / "CHANGELOG.md").read_text()
    assert metadata.version("scene-experts") == scene_experts.__version__


def test_all_is_every_extra_of_a_user_without_cuda():
    extras = PROJECT["optional-dependencies"]
    (everything,) = extras["all"]
    assert set(re.findall(r"[\w]+", everything.partition("[")[2])) == set(extras) - {"all", "cuda", "docs", "test"}


def test_workflows_run_commands_that_exist():
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert len(FLOWS) == 3
    for path in FLOWS:
        jobs = yaml.safe_load(path.read_text())["jobs"]
        runs = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
        for line in runs:
            words = line.split()
            assert (words[0] == "make" and words[1] in targets) or line == "bash .ci/run", line
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    assert [hook["id"] for hook in hooks] == ["ruff", "ruff-format"]
    named = set(re.findall(r"`make ([\w-]+)", (ROOT / "CONTRIBUTING.md").read_text()))
    assert named <= targets
