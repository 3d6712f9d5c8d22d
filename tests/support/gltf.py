"""The JSON, the binary part and the columns of a glTF file, read without the package."""

import json
import struct

import numpy as np


def parsed(path):
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[20 + size + 8 :]


def column(doc, body, name):
    accessor = doc["accessors"][doc["meshes"][0]["primitives"][0]["attributes"][name]]
    view = doc["bufferViews"][accessor["bufferView"]]
    kind = np.uint8 if accessor["componentType"] == 5121 else np.float32
    flat = np.frombuffer(body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]], kind)
    return flat.reshape(accessor["count"], -1)
