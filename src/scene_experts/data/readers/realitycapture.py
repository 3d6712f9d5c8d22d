"""Reads the CSV file "Internal/External camera parameters" of RealityCapture and RealityScan.

x, y and alt are the camera's centre. With heading, pitch and roll of 0 a camera looks down, and the
top of its picture points along y; heading turns clockwise about the vertical, then pitch lifts the
view towards the horizon, then roll tilts the picture. f is in mm for a picture of 36 mm on its
longer side; px and py are offsets from the picture's middle as shares of that side. The distortion
is Brown's with four radial coefficients; OpenCV calls t2 p1 and t1 p2.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import CAPTURE, POSES
from scene_experts.core.reading.plain import decode_text
from scene_experts.core.reading.source import guarding, opening
from scene_experts.data.images import Size
from scene_experts.data.lens import Lens
from scene_experts.data.readers import poses
from scene_experts.data.readers.reader import RawCapture, ReadOptions

_ALIASES = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py", "z": "alt"}
_NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
_OPTIONAL = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
_FILM = 36.0  # mm of the longer side


class RealityCaptureReader:
    """Reads poses and lenses of a CSV file beside the photographs. Their points come from a PLY
    file beside it."""

    name = "realitycapture"
    files = "a CSV file of camera parameters (RealityCapture, RealityScan)"

    def recognise(self, folder: Path) -> bool:
        return bool(_find(folder))

    def read(self, folder: Path, options: ReadOptions) -> RawCapture:
        """Read the poses. Raises InputError if a row is damaged, a photograph is listed twice, or
        photographs are absent (with `options.missing == "drop"`: if all are)."""
        with guarding(folder, CAPTURE):
            warnings: list[str] = []
            path = poses.choose_file(folder, _find(folder), options, warnings)
            return poses.assemble(folder, path, _read_poses(path, warnings), options, warnings)


def _find(folder: Path) -> list[Path]:
    return poses.find_files(folder, "*.csv", lambda head: _header(head.splitlines()) is not None)


def _header(lines: list[str]) -> tuple[int, str, list[str]] | None:
    """Return the line of the column names, its delimiter and the names, or None without the needed
    ones."""
    for index, line in enumerate(lines[:3]):  # "#cameras 12" may come first
        for delimiter in ",;\t":
            names = [name.strip(' #"').lower() for name in line.split(delimiter)]
            names = [_ALIASES.get(name, name) for name in names]
            if all(name in names for name in _NEEDED):
                return index, delimiter, names
    return None


def _read_poses(path: Path, warnings: list[str]) -> list[poses.Pose]:
    with opening(path, POSES) as source:
        lines = decode_text(source.read()).splitlines()
        header = _header(lines)
        if header is None:
            raise InputError(
                f"expected the columns {', '.join(_NEEDED)} in {path}, found others; export Internal/External camera parameters"
            )
        start, delimiter, names = header
        rows = []
        for row in csv.reader(lines[start + 1 :], delimiter=delimiter):
            source.spend_items(len(row))
            if not any(cell.strip() for cell in row) or row[0].startswith("#"):
                continue
            if len(row) < len(names):
                raise InputError(f"expected {len(names)} values in every row of {path}, found {len(row)} in one; export it again")
            cells = dict(zip(names, row))
            numbers = [name for name in (*_NEEDED[1:], *_OPTIONAL) if name in cells]
            values = poses.to_numbers((cells[name] for name in numbers), len(numbers), f"the row of {cells['name']}", path)
            rows.append((cells["name"].strip(), {**dict.fromkeys(_OPTIONAL, 0.0), **dict(zip(numbers, values))}))
    unit = 1.0
    if any(max(abs(row["px"]), abs(row["py"])) > 0.5 for _, row in rows):  # a share of the side cannot be larger
        unit = _FILM
        warnings.append(f"px and py of {path.name} are read as mm of a side of 36, because they are too large for shares of it")
    if any(row["k1"] for _, row in rows) and not any(row[name] for _, row in rows for name in _OPTIONAL[3:]):
        warnings.append(
            f"{path.name} has k1 alone, which is read as Brown's: if the distortion model is Division, which the file does not say, choose "
            f"Brown3 in the program and export again"
        )
    _tell_degrees(path, rows, warnings)
    return [poses.Pose(name, _pose(row), _lens(row, unit)) for name, row in rows]


def _pose(row: dict[str, float]) -> np.ndarray:
    """Return the world-to-camera matrix [4, 4] of a row."""
    heading, pitch, roll = (np.deg2rad(row[name]) for name in ("heading", "pitch", "roll"))
    (ch, cp, cr), (sh, sp, sr) = np.cos((heading, pitch, roll)), np.sin((heading, pitch, roll))
    turn = np.array([[ch, sh, 0], [-sh, ch, 0], [0, 0, 1]])  # clockwise about the vertical
    lift = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    tilt = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    axes = turn @ lift @ tilt  # columns: right, up, back
    return poses.to_world_to_cam(axes * (1.0, -1.0, -1.0), np.array([row["x"], row["y"], row["alt"]]))


def _lens(row: dict[str, float], unit: float) -> Callable[[Size], Lens]:
    def lens(size: Size) -> Lens:
        width, height = size
        side = max(width, height)
        f = row["f"] / _FILM * side
        centre = (width / 2 + row["px"] / unit * side, height / 2 + row["py"] / unit * side)
        if not any(row[name] for name in _OPTIONAL[2:]):
            return Lens("PINHOLE", width, height, (f, f, *centre))
        bends = (row["k1"], row["k2"], row["t2"], row["t1"], row["k3"], row["k4"])
        return Lens("BROWN", width, height, (f, f, *centre, *bends, 0.0))

    return lens


def _tell_degrees(path: Path, rows: list[tuple[str, dict[str, float]]], warnings: list[str]) -> None:
    """Add a warning if the positions look like degrees of longitude and latitude beside metres of
    height."""
    if len(rows) < 2:
        return
    xyz = np.array([[row[name] for name in ("x", "y", "alt")] for _, row in rows])
    across, up = np.ptp(xyz[:, :2], axis=0).max(), np.ptp(xyz[:, 2])
    if (np.abs(xyz[:, :2]) <= (180, 90)).all() and across < 0.1 and up > 50 * across:
        warnings.append(f"the positions in {path.name} look like degrees beside metres; export them in a coordinate system in metres")


READER = RealityCaptureReader()
