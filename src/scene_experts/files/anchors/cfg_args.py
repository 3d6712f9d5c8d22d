"""cfg_args, the settings of a run in the 3DGS family: the text of a Python namespace, parsed as literals and never evaluated."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError

_SIZE_LIMIT = 1 << 20


def read_cfg_args(path: Path) -> dict[str, Any]:
    """The settings in `Namespace(voxel_size=0.001, ...)`; those that are no literal (a path object, a call) are left out.

    Raises InputError when the file is not the text of a namespace.
    """
    path = Path(path)
    wrong = f"expected the text Namespace(name=value, ...) in {path}, found something else; remove the file to go on without it"
    try:
        text = path.read_bytes()[: _SIZE_LIMIT + 1].decode()
        call = ast.parse(text.strip(), mode="eval").body if len(text) <= _SIZE_LIMIT else None
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        raise InputError(wrong) from None
    if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Namespace" and not call.args):
        raise InputError(wrong)
    out: dict[str, Any] = {}
    for keyword in call.keywords:
        try:
            if keyword.arg is not None:
                out[keyword.arg] = ast.literal_eval(keyword.value)
        except (ValueError, TypeError, MemoryError, RecursionError):
            continue
    return out


def cfg_args_text(values: Mapping[str, Any]) -> str:
    """The text that the readers of this family expect: Namespace(a=1, b='x'). Values must be literals."""
    return f"Namespace({', '.join(f'{name}={value!r}' for name, value in values.items())})"
