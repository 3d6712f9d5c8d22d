"""Reads the cameras that Agisoft Metashape exports as XML.

A camera's transform maps its axes (x right, y down, z forward) to the frame of its chunk; the
transform of its component, or of the chunk, maps that to the world: a rotation, a translation and a
scale. The lens is Brown's: f, cx and cy (from the picture's middle), b1 and b2 in pixels, K1 to K4,
and P1 and P2, which OpenCV calls p2 and p1.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import CAPTURE, POSES, Damaged
from scene_experts.core.reading.markup import parse_xml
from scene_experts.core.reading.numbers import to_size
from scene_experts.core.reading.source import guarding, opening, shorten
from scene_experts.data.lens import Lens
from scene_experts.data.readers import poses
from scene_experts.data.readers.reader import RawCapture, ReadOptions

Matrix = NDArray[np.float64]
Frame = tuple[Matrix, Matrix, float]  # rotation, translation, scale
_FISHEYE = ("fisheye", "equidistant_fisheye")
_GLOBE = (6.3e6, 6.5e6)  # m: from the middle of the earth to its surface


class MetashapeReader:
    """Reads cameras.xml, beside the photographs. Their points come from a PLY file beside it."""

    name = "metashape"
    files = "an XML file of cameras (Metashape)"

    def recognise(self, folder: Path) -> bool:
        return bool(_find(folder))

    def read(self, folder: Path, options: ReadOptions) -> RawCapture:
        """Read the poses of the chunk that has most. Cameras without a pose and disabled ones are
        left out, with a warning.

        Raises InputError if the file is damaged, for lenses that are neither frame nor equidistant
        fisheye, and if photographs are absent (with `options.missing == "drop"`: if all are).
        """
        with guarding(folder, CAPTURE):
            warnings: list[str] = []
            path = poses.choose_file(folder, _find(folder), options, warnings)
            with opening(path, POSES) as source:
                root = parse_xml(source)
                chunk = _choose_chunk(root, path, warnings)
                posed = _read_poses(chunk, path, warnings)
            return poses.assemble(folder, path, posed, options, warnings)


def _find(folder: Path) -> list[Path]:
    return poses.find_files(folder, "*.xml", lambda head: "<document" in head and "<chunk" in head)


def _choose_chunk(root: Element, path: Path, warnings: list[str]) -> Element:
    chunks = [root] if root.tag == "chunk" else root.findall("chunk")
    counts = [len(chunk.findall("cameras//camera/transform")) for chunk in chunks]
    if not any(counts):
        raise InputError(f"expected cameras with a transform in {path}, found none; align the photographs and export the cameras again")
    best = counts.index(max(counts))
    if sum(count > 0 for count in counts) > 1:
        warnings.append(
            f"{path.name} holds chunks of {', '.join(map(str, counts))} cameras; the one of {counts[best]} is read; export one alone"
        )
    return chunks[best]


def _read_poses(chunk: Element, path: Path, warnings: list[str]) -> list[poses.Pose]:
    lenses: dict[str, Lens] = {}
    sensors = {sensor.get("id", ""): sensor for sensor in chunk.findall("sensors/sensor")}
    frames = {c.get("id", ""): _read_frame(c.find("transform"), path) for c in chunk.findall("components/component")}
    frames[""] = _read_frame(chunk.find("transform"), path)
    if not (chunk.findtext("reference") or "").strip().startswith("LOCAL_CS"):
        frames = _flatten(frames, path, warnings)
    out, idle, bare = [], 0, 0
    for camera in chunk.findall("cameras//camera"):
        label, transform = camera.get("label") or "", camera.findtext("transform")
        if camera.get("enabled", "1").lower() in ("0", "false"):
            idle += 1
            continue
        if transform is None:
            bare += 1
            continue
        key = camera.get("sensor_id", "")
        if key not in sensors:
            raise InputError(
                f"expected sensor {shorten(key)} of {shorten(label)} in {path}, found no such sensor; export the cameras again"
            )
        lens = lenses.setdefault(key, _read_lens(sensors[key], path)) if key not in lenses else lenses[key]
        numbers = poses.to_numbers(transform.split(), 16, f"the transform of {label}", path)
        pose = np.array(numbers).reshape(4, 4)
        rotation, centre = poses.nearest_rotation(pose[:3, :3], label, path), pose[:3, 3]
        frame = frames.get(camera.get("component_id", "")) or frames[""]
        if frame is not None:
            turn, shift, scale = frame
            rotation, centre = turn @ rotation, scale * (turn @ centre) + shift
        out.append(poses.Pose(label, poses.to_world_to_cam(rotation, centre), lambda _, lens=lens: lens))
    for count, what in ((idle, "are disabled"), (bare, "have no pose")):
        if count:
            warnings.append(f"{count} cameras in {path.name} {what} and are left out")
    return out


def _read_frame(element: Element | None, path: Path) -> Frame | None:
    """Return the rotation, translation and scale of a chunk or component, or None without one."""
    if element is None:
        return None
    texts = [
        element.findtext(name) or usual for name, usual in (("rotation", "1 0 0 0 1 0 0 0 1"), ("translation", "0 0 0"), ("scale", "1"))
    ]
    turn, shift, (scale,) = (poses.to_numbers(text.split(), n, "a transform", path) for text, n in zip(texts, (9, 3, 1)))
    if not 1e-9 < scale < 1e9:
        raise Damaged(f"a scale of {scale:g}")
    return poses.nearest_rotation(np.array(turn).reshape(3, 3), "the chunk", path), np.array(shift), scale


def _flatten(frames: dict[str, Frame | None], path: Path, warnings: list[str]) -> dict[str, Frame | None]:
    """Return frames that map to metres east, north and up of one of them, if they map to the globe
    (geocentric metres on WGS 84); otherwise the frames as they are. Adds a note."""
    far = [frame for frame in frames.values() if frame is not None and _GLOBE[0] < float(np.linalg.norm(frame[1])) < _GLOBE[1]]
    if not far:
        return frames
    origin = far[0][1]
    longitude, latitude = _place(origin)
    (cl, cp), (sl, sp) = np.cos((longitude, latitude)), np.sin((longitude, latitude))
    local = np.array([[-sl, cl, 0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])  # rows: east, north, up
    warnings.append(
        f"{path.name} is georeferenced: positions are in metres east, north and up of {np.rad2deg(latitude):.6f} degrees north, "
        f"{np.rad2deg(longitude):.6f} east, which points must be too"
    )
    return {key: frame and (local @ frame[0], local @ (frame[1] - origin), frame[2]) for key, frame in frames.items()}


def _place(xyz: Matrix) -> tuple[float, float]:
    """Return the longitude and latitude, in radians, of a geocentric position on WGS 84."""
    squashed = 1 / 298.257223563
    eccentric, across = squashed * (2 - squashed), float(np.hypot(xyz[0], xyz[1]))
    latitude = np.arctan2(xyz[2], across * (1 - eccentric))
    for _ in range(10):
        normal = 6378137.0 / np.sqrt(1 - eccentric * np.sin(latitude) ** 2)
        latitude = np.arctan2(xyz[2] + eccentric * normal * np.sin(latitude), across)
    return float(np.arctan2(xyz[1], xyz[0])), float(latitude)


def _read_lens(sensor: Element, path: Path) -> Lens:
    """Return the lens of a sensor: its adjusted calibration, else its initial one."""
    kind = sensor.get("type", "frame")
    if kind != "frame" and kind not in _FISHEYE:
        raise InputError(
            f"expected sensors of type frame or fisheye in {path}, found {shorten(kind)!r}; export undistorted photographs and cameras"
        )
    found = sorted(sensor.findall("calibration"), key=lambda c: c.get("class") != "adjusted")
    found = [calibration for calibration in found if calibration.find("f") is not None]
    size = next((e for e in (*(c.find("resolution") for c in found), sensor.find("resolution")) if e is not None), None)
    if not found or size is None:
        raise InputError(f"expected a calibration with f, and a size, for every sensor in {path}, found none; align and export again")
    names = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
    numbers = poses.to_numbers([found[0].findtext(name) or "0" for name in names], len(names), "a calibration", path)
    f, cx, cy, b1, b2, k1, k2, k3, k4, p1, p2 = numbers
    try:
        width, height = to_size(size.get("width")), to_size(size.get("height"))
    except (TypeError, ValueError):
        raise InputError(f"expected whole numbers as a resolution in {path}, found others; export the cameras again") from None
    shared = (f + b1, f, width / 2 + cx, height / 2 + cy)
    if kind in _FISHEYE:
        if b2:
            raise InputError(f"expected a fisheye lens without b2 in {path}, found {b2:g}; fit it without b2 and export again")
        return Lens("THIN_PRISM_FISHEYE", width, height, (*shared, k1, k2, p2, p1, k3, k4, 0.0, 0.0))
    if not any(numbers[4:]):
        return Lens("PINHOLE", width, height, shared)
    return Lens("BROWN", width, height, (*shared, k1, k2, p2, p1, k3, k4, b2 / (f + b1) if f + b1 else 0.0))


READER = MetashapeReader()
