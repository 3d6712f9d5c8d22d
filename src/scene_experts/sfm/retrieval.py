"""Finds which photographs show the same things, by the features that COLMAP has extracted.

A photograph is described by one vector (VLAD: Jegou et al., "Aggregating local descriptors into a
compact image representation", CVPR 2010). The descriptors of all photographs are divided into
clusters; each cluster has the sum of the differences between its descriptors and its centre. The
parts are normalised one by one (Arandjelovic and Zisserman, "All about VLAD", CVPR 2013). The
product of two vectors says how much alike their photographs are.
"""

from __future__ import annotations

import sqlite3
import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

CENTRES = 64
LARGEST = 2000  # features of a photograph that are used: those of the largest scale, which other photographs see too
SAMPLED = 50_000  # descriptors that the centres are found from
ROUNDS = 10  # of k-means
BLOCK = 512  # photographs whose likeness to all others is computed at a time


def describe_photos(database: Path, names: Sequence[str]) -> NDArray[np.float32]:
    """Return one vector of length 1 for each photograph of COLMAP's database [N, CENTRES * D]; zeros
    for a photograph without features. The same features give the same vectors."""
    each = max(20, SAMPLED // max(len(names), 1))
    parts = [_spread(found, each) for found in read_largest(database, names)]
    sample = np.concatenate([part for part in parts if len(part)] or [np.zeros((0, 1), np.float32)])
    if len(sample) <= CENTRES:
        return np.zeros((len(names), 1), np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an empty cluster keeps its centre
        centres, _ = kmeans2(sample, _spread(sample, CENTRES), iter=ROUNDS, minit="matrix")
    return np.stack([aggregate(found, centres) for found in read_largest(database, names)])


def read_largest(database: Path, names: Sequence[str]) -> Iterator[NDArray[np.float32]]:
    """Yield the descriptors of each photograph, of length 1 [n, D]: those of its largest features,
    at most LARGEST; n = 0 for one without."""
    with closing(sqlite3.connect(f"file:{database.as_posix()}?mode=ro", uri=True)) as there:
        ids = dict(there.execute("SELECT name, image_id FROM images"))
        for name in names:
            keypoints = _read_array(there, "keypoints", ids.get(name), np.float32)
            found = _read_array(there, "descriptors", ids.get(name), np.uint8).astype(np.float32)
            if len(keypoints) == len(found) and keypoints.shape[1] >= 3:
                # COLMAP keeps scale and angle, or the four numbers of an affine shape
                size = keypoints[:, 2] if keypoints.shape[1] < 6 else np.hypot(keypoints[:, 2], keypoints[:, 4])
                found = found[np.argsort(-size, kind="stable")[:LARGEST]]
            yield found[:LARGEST] / np.maximum(np.linalg.norm(found[:LARGEST], axis=1, keepdims=True), 1e-6)


def _read_array(there: sqlite3.Connection, table: str, image: int | None, dtype: type) -> NDArray:
    row = there.execute(f"SELECT rows, cols, data FROM {table} WHERE image_id = ?", (image,)).fetchone()
    if row is None or not row[0]:
        return np.zeros((0, 0), dtype)
    return np.frombuffer(row[2], dtype).reshape(row[0], row[1])


def _spread(rows: NDArray, count: int) -> NDArray:
    """Return at most `count` of the rows, evenly spread."""
    return rows if len(rows) <= count else rows[np.arange(count) * len(rows) // count]


def aggregate(found: NDArray[np.float32], centres: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the VLAD vector of descriptors [n, D] for `centres` [C, D]: [C * D], of length 1, or 0
    without descriptors."""
    sums = np.zeros_like(centres, dtype=np.float32)
    if len(found):
        nearest = np.argmax(found @ centres.T - 0.5 * np.square(centres).sum(1), axis=1)
        np.add.at(sums, nearest, found - centres[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-6)
    flat = sums.ravel()
    return flat / max(float(np.linalg.norm(flat)), 1e-6)


def rank_alike(vectors: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """Return for each photograph the `count` others that are most like it, the most alike first
    [N, count]; all others where there are fewer."""
    total = len(vectors)
    count = max(0, min(count, total - 1))
    ranks = np.zeros((total, count), np.int64)
    for first in range(0, total, BLOCK):
        likeness = vectors[first : first + BLOCK] @ vectors.T
        own = np.arange(len(likeness))
        likeness[own, first + own] = -np.inf
        ranks[first : first + BLOCK] = np.argsort(-likeness, axis=1, kind="stable")[:, :count]
    return ranks
