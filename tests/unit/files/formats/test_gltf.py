"""glTF containers: buffers, buffer views and accessors. What whole files say is in test_glb.py."""

import base64
import json
import struct

import numpy as np
import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import Budget
from scene_experts.core.reading.source import opening
from scene_experts.files.formats.gltf import GltfFile
from support.messages import naming

GLTF = Budget("glTF file", 1 << 30)


def accessor(path, doc, index=0):
    path.write_text(json.dumps(doc))
    with opening(path, GLTF) as source:
        return GltfFile(source).accessor(index)


def test_accessors_of_several_buffers(tmp_path):
    first, second = np.arange(6, dtype="<f4"), np.arange(8, dtype=np.uint8)
    (tmp_path / "b").write_bytes(second.tobytes())
    doc = {
        "buffers": [{"uri": "data:;base64," + base64.b64encode(first.tobytes()).decode()}, {"uri": "b"}],
        "bufferViews": [{"buffer": 0, "byteOffset": 4}, {"buffer": 1, "byteStride": 4}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 1, "type": "VEC3", "byteOffset": 4},
            {"bufferView": 1, "componentType": 5121, "count": 2, "type": "VEC2", "normalized": True},
        ],
    }
    assert accessor(tmp_path / "a.gltf", doc).tolist() == [[2, 3, 4]]
    np.testing.assert_allclose(accessor(tmp_path / "a.gltf", doc, 1), np.array([[0, 1], [4, 5]]) / 255)


def test_many_values_are_refused_before_they_are_parsed(tmp_path):
    (tmp_path / "a.gltf").write_bytes(b"[" + b"[]," * 4_000_001 + b"[]]")
    with pytest.raises(InputError, match=naming("a.gltf", "4,000,000")), opening(tmp_path / "a.gltf", GLTF) as source:
        GltfFile(source)


def test_a_binary_file_without_a_binary_part(tmp_path):
    text = json.dumps({"buffers": [{}], "bufferViews": [{}]}).encode()
    (tmp_path / "a").write_bytes(struct.pack("<III", 0x46546C67, 2, 20 + len(text)) + struct.pack("<II", len(text), 0x4E4F534A) + text)
    with pytest.raises(InputError, match=naming("a", "buffer 0")), opening(tmp_path / "a", GLTF) as source:
        GltfFile(source).buffer(0)
