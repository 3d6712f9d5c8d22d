"""Finds the keypoints of photographs by ALIKED and matches them by LightGlue.

Each photograph and each pair is one file of the work folder, so that an interrupted call is
continued. Each is computed by one thread, so the results are the same at any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from torch.nn import functional

from scene_experts.core.io import write_atomic
from scene_experts.core.progress import Progress
from scene_experts.core.reading.budget import CAPTURED, FEATURES
from scene_experts.core.reading.pictures import opening_picture
from scene_experts.core.reading.tensors import read_safetensors
from scene_experts.data.store import available_bytes
from scene_experts.sfm.learned.aliked import COARSEST, Aliked
from scene_experts.sfm.learned.keypoints import find_keypoints
from scene_experts.sfm.learned.lightglue import Keypoints, LightGlue

MOST = 1024  # keypoints of a photograph; a pair takes a second of a core, with twice as many three
LEAST_SCORE = 0.02
LARGEST = 1024  # px of the longest side at which they are found: larger ones are no more precise, and take longer
BYTES_PER_PIXEL = 800  # of the networks' layers while a photograph is looked at


@dataclass(frozen=True)
class Shots:
    """Photographs whose features are found.

    Attributes:
        names: Their names in `images`.
        images: Their folder.
        masks: Folder of masks NAME.png, black where no features count; None without masks.
        folder: Where the results are kept.
        max_side: Longest side in pixels at which features are found, LARGEST at most.
        threads: Number of threads.
    """

    names: Sequence[str]
    images: Path
    masks: Path | None
    folder: Path
    max_side: int
    threads: int

    def features(self, i: int) -> Path:
        """Return the file of the keypoints of photograph i."""
        return self.folder / f"{i}.safetensors"

    def matches(self, i: int, j: int) -> Path:
        """Return the file of the matches of photographs i and j."""
        return self.folder / f"{i}-{j}.safetensors"


def find_features(shots: Shots, network: Aliked, progress: Progress) -> None:
    """Find the keypoints of each photograph that has none yet. Raises InputError if a photograph
    cannot be read."""
    free = available_bytes()
    each = 2 * BYTES_PER_PIXEL * min(shots.max_side, LARGEST) ** 2
    at_once = shots.threads if free is None else min(shots.threads, max(1, free // each))
    tasks = [partial(write_features, shots, i, network) for i in range(len(shots.names)) if not shots.features(i).is_file()]
    run_all(tasks, at_once, partial(report, progress, "learned features", len(shots.names) - len(tasks), len(shots.names)))


def find_matches(shots: Shots, pairs: Sequence[tuple[int, int]], network: LightGlue, progress: Progress) -> None:
    """Match each of the pairs of photographs that is not matched yet."""
    tasks = [partial(write_matches, shots, i, j, network) for i, j in pairs if not shots.matches(i, j).is_file()]
    run_all(tasks, shots.threads, partial(report, progress, "learned matches", len(pairs) - len(tasks), len(pairs)))


def report(progress: Progress, what: str, before: int, total: int, done: int) -> None:
    progress(what, before + done, total)


def run_all(tasks: Sequence[Callable[[], None]], threads: int, tell: Callable[[int], None]) -> None:
    """Run the tasks, each in one thread; `tell` hears how many are done. The first failure ends all
    and is raised."""
    before = torch.get_num_threads()
    pool = ThreadPoolExecutor(threads, initializer=partial(torch.set_num_threads, 1))
    try:
        tell(0)
        for done, future in enumerate(as_completed([pool.submit(task) for task in tasks]), start=1):
            future.result()
            tell(done)
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(before)  # new threads take over what another thread has set last


def write_features(shots: Shots, i: int, network: Aliked) -> None:
    """Find the keypoints of photograph i and write them: `places` in pixels of the photograph, 0.5 at
    the centre of the first one, `descriptors`, and `size`."""
    name = shots.names[i]
    picture, size = read_picture(shots.images / name, min(shots.max_side, LARGEST))
    height, width = picture.shape[1:]
    features, scores = network.look(pad(picture))
    scores = scores[:height, :width]
    scale = torch.tensor(size, dtype=torch.float32) / torch.tensor([width, height])
    if shots.masks is not None:
        scores = scores * read_mask(shots.masks / f"{name}.png", (width, height))
    places, _ = find_keypoints(scores, MOST, LEAST_SCORE)
    found = {"places": (places + 0.5) * scale, "descriptors": network.describe(features, places), "size": torch.tensor(size)}
    save(shots.features(i), found)


def pad(picture: Tensor) -> Tensor:
    """Repeat the last row and column of a picture [3, H, W] until its sides are multiples of COARSEST,
    and twice that at least."""
    more = [max(2 * COARSEST, -(-side // COARSEST) * COARSEST) - side for side in picture.shape[1:]]
    return functional.pad(picture[None], (0, more[1], 0, more[0]), mode="replicate")[0]


def read_picture(path: Path, max_side: int) -> tuple[Tensor, tuple[int, int]]:
    """Return a photograph [3, H, W] in [0, 1], its longer side at most `max_side`, and its width and
    height as it is stored. Raises InputError if it cannot be read."""
    with opening_picture(path, CAPTURED, heic=True) as image:
        size = image.size
        scale = min(1.0, max_side / max(size))
        small = (max(1, round(size[0] * scale)), max(1, round(size[1] * scale)))
        rgb = image.convert("RGB")
        rgb = rgb if small == size else rgb.resize(small, Image.Resampling.LANCZOS)
        return torch.from_numpy(np.array(rgb)).permute(2, 0, 1).float() / 255, size


def read_mask(path: Path, size: tuple[int, int]) -> Tensor:
    """Return a mask [H, W] at `size` (width, height): 1 where features count, 0 elsewhere."""
    with opening_picture(path, CAPTURED) as image:
        return torch.from_numpy(np.array(image.convert("L").resize(size, Image.Resampling.NEAREST)) >= 128).float()


def write_matches(shots: Shots, i: int, j: int, network: LightGlue) -> None:
    """Match photographs i and j and write `matches` [M, 2], indices into their keypoints."""
    one, other = (read_features(shots, k) for k in (i, j))
    save(shots.matches(i, j), {"matches": network.match(one, other)[0]})


def read_features(shots: Shots, i: int) -> Keypoints:
    """Read the keypoints of photograph i."""
    found, _ = read_safetensors(shots.features(i), FEATURES)
    width, height = found["size"].tolist()
    return Keypoints(found["places"], found["descriptors"], (width, height))


def save(path: Path, tensors: dict[str, Tensor]) -> None:
    whole = {name: value.contiguous() for name, value in tensors.items()}
    write_atomic(path, lambda temporary: safetensors.torch.save_file(whole, temporary))


def write_for_colmap(shots: Shots, pairs: Iterable[tuple[int, int]], path: Path) -> None:
    """Write what COLMAP's process adds to its database as an npz file: the places `k<i>` [N, 2] of
    photograph i, `pairs` [P, 2], and the matches `m<p>` [M, 2] of pair p, where there are any."""
    out: dict[str, NDArray] = {f"k{i}": read_features(shots, i).places.numpy() for i in range(len(shots.names))}
    kept = []
    for i, j in pairs:
        matches = read_safetensors(shots.matches(i, j), FEATURES)[0]["matches"]
        if len(matches):
            out[f"m{len(kept)}"] = matches.numpy().astype(np.uint32)
            kept.append((i, j))
    out["pairs"] = np.array(kept, np.int64).reshape(-1, 2)
    write_atomic(path, partial(save_arrays, out))


def save_arrays(arrays: dict[str, NDArray], path: Path) -> None:
    with path.open("wb") as stream:  # given a path, numpy would add an ending to its name
        np.savez(stream, allow_pickle=False, **arrays)
