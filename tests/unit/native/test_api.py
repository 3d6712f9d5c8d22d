"""native/api.py is the twin of csrc/se_api.h: the same functions, structures, types, sizes and offsets."""

import ctypes
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from scene_experts.native import api
from scene_experts.native import library as native
from support.places import ROOT

HEADER = ROOT / "csrc" / "se_api.h"
SCALARS = {
    "int32_t": ctypes.c_int32,
    "int64_t": ctypes.c_int64,
    "float": ctypes.c_float,
    "double": ctypes.c_double,
    "void": None,
}
STRUCTURES = {structure.__name__: structure for structure in api.STRUCTURES}


def header() -> str:
    """The header without comments and preprocessor lines."""
    return re.sub(r"//.*|^#.*", "", HEADER.read_text(), flags=re.MULTILINE)


def convert(base: str, pointers: int):
    """The ctypes type of a C type, as api.py writes it."""
    if pointers == 0:
        return STRUCTURES.get(base) or SCALARS[base]
    if pointers == 1:
        return ctypes.POINTER(STRUCTURES[base]) if base in STRUCTURES else ctypes.c_void_p
    return ctypes.POINTER(convert(base, pointers - 1))


def declared_functions() -> dict[str, tuple]:
    found = {}
    for result, name, arguments in re.findall(r"SE_EXPORT (\w+) (\w+)\(([^)]*)\);", header()):
        types = []
        for argument in arguments.split(",") if arguments != "void" else ():
            base, stars = re.fullmatch(r"\s*(?:const )?(\w+)\s*(\**)\s*\w+", argument).groups()
            types.append(convert(base, len(stars)))
        found[name] = (convert(result, 0), tuple(types))
    return found


def declared_structures() -> dict[str, list]:
    found = {}
    for body, name in re.findall(r"typedef struct \{(.*?)\} (\w+);", header(), flags=re.DOTALL):
        fields = []
        for declaration in filter(None, map(str.strip, body.split(";"))):
            base, variables = re.fullmatch(r"(?:const )?(\w+)(.*)", declaration, flags=re.DOTALL).groups()
            for variable in variables.split(","):
                stars, field, length = re.fullmatch(r"\s*(\**)\s*(\w+)(?:\[(\d+)\])?\s*", variable).groups()
                kind = convert(base, len(stars))
                fields.append((field, kind * int(length) if length else kind))
        found[name] = fields
    return found


def test_functions_are_those_of_the_header():
    declared = declared_functions()
    assert len(declared) == HEADER.read_text().count("SE_EXPORT ") - 2  # every declaration is understood; two lines define the macro
    assert declared == api.FUNCTIONS


def test_structures_are_those_of_the_header():
    declared = declared_structures()
    assert len(declared) == HEADER.read_text().count("typedef struct")
    assert declared == {name: list(structure._fields_) for name, structure in STRUCTURES.items()}


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_a_c_compiler_lays_the_structures_out_alike(tmp_path: Path):
    places = [(name, field) for name, structure in STRUCTURES.items() for field, *_ in structure._fields_]
    lines = [f'printf("%zu %zu\\n", offsetof({name}, {field}), sizeof((({name}*)0)->{field}));' for name, field in places]
    lines += [f'printf("%zu\\n", sizeof({name}));' for name in STRUCTURES]
    program = tmp_path / "layout.c"
    program.write_text(
        "#include <stddef.h>\n#include <stdio.h>\n" + f'#include "{HEADER}"\n' + "int main(void) {" + "\n".join(lines) + "return 0; }"
    )
    subprocess.run(["cc", "-std=c99", "-Wall", "-Werror", "-o", str(tmp_path / "layout"), str(program)], check=True)
    found = subprocess.run([str(tmp_path / "layout")], check=True, capture_output=True, text=True).stdout.splitlines()
    expected = [(getattr(STRUCTURES[name], field).offset, getattr(STRUCTURES[name], field).size) for name, field in places]
    assert found == [f"{offset} {size}" for offset, size in expected] + [str(ctypes.sizeof(s)) for s in STRUCTURES.values()]


@pytest.mark.parametrize("level", [level for level in native.list_levels() if native.find(level)])
def test_a_built_library_has_every_function_and_this_version(level):
    library = ctypes.CDLL(str(native.find(level)))
    assert library.se_abi_version() == api.ABI_VERSION
    api.bind(library)
    assert library.se_adam_step.argtypes == list(api.FUNCTIONS["se_adam_step"][1])


def test_a_library_without_a_function_is_refused():
    with pytest.raises(AttributeError):
        api.bind(ctypes.CDLL(None))
