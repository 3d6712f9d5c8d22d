"""The frame cache: it never exceeds its limit, frames do not depend on the thread, and it ends cleanly."""

from __future__ import annotations

import gc
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data import store as module
from scene_experts.data.images import FrameSource, decode
from scene_experts.data.lens import Lens
from scene_experts.data.store import ImageStore, available_bytes
from support.messages import naming

W, H = 20, 10
FRAME = W * H * 3


def sources(folder: Path, count: int) -> list[FrameSource]:
    out = []
    for i in range(count):
        path = folder / f"{i}.png"
        Image.fromarray(np.random.default_rng(i).integers(0, 256, (H, W, 3)).astype(np.uint8)).save(path)
        out.append(FrameSource(path, Lens("PINHOLE", W, H, (9.0, 9.0, 10.0, 5.0)), (W, H)))
    return out


def truth(index: int) -> np.ndarray:
    return np.random.default_rng(index).integers(0, 256, (H, W, 3)).astype(np.uint8)


def wait(condition: object) -> None:
    end = time.monotonic() + 10
    while not condition() and time.monotonic() < end:  # type: ignore[operator]
        time.sleep(0.002)
    assert condition()  # type: ignore[operator]


@pytest.fixture
def threads() -> Callable[[], int]:
    """Return the number of decoding threads that this test started and that still run."""
    named = lambda: {t for t in threading.enumerate() if t.name == "scene-experts images"}  # noqa: E731
    before = named()
    return lambda: len(named() - before)


def test_the_most_recently_used_frame_is_dropped_first(tmp_path: Path) -> None:
    store = ImageStore(sources(tmp_path, 4), cache_bytes=2 * FRAME)
    a = store.get(0)[0]
    store.get(1)
    store.get(2)  # drops 1
    assert store.get(0)[0] is a and store.used_bytes == 2 * FRAME
    (tmp_path / "1.png").unlink()
    with pytest.raises(InputError, match=naming(tmp_path)):
        store.get(1)


def test_a_lower_limit_drops_frames(tmp_path: Path) -> None:
    store = ImageStore(sources(tmp_path, 3))
    size = store.count_bytes([0])
    assert store.count_bytes([0, 1, 2]) == 3 * size > 0
    for index in range(3):
        store.get(index)
    store.limit(2 * size)
    store.limit(1000 * size)  # a limit is never raised
    store.get(0)
    store.close()
    store = ImageStore(sources(tmp_path, 3))
    store.limit(2 * size)
    for index in range(3):
        store.get(index)
    assert store.cache_bytes == 2 * size and store.used_bytes <= 2 * size
    store.close()


def test_prefetched_frames_are_not_dropped(tmp_path: Path) -> None:
    store = ImageStore(sources(tmp_path, 9), cache_bytes=6 * FRAME)
    store.get(0)
    store.prefetch([3, 1])
    wait(lambda: store.used_bytes == 3 * FRAME)
    for i in (3, 1):
        (tmp_path / f"{i}.png").unlink()  # they can come only from memory now
    for i in (4, 5, 6, 7, 8):
        store.get(i)
    for i in (3, 1):
        np.testing.assert_array_equal(store.get(i)[0], truth(i))
    store.close()


def test_epochs_in_random_order_hit_the_cache_as_often_as_possible(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded = []
    store = ImageStore(sources(tmp_path, 20), cache_bytes=10 * FRAME)
    monkeypatch.setattr("scene_experts.data.store.decode", lambda source: decoded.append(source) or decode(source))
    rng = np.random.default_rng(0)
    for _ in range(20):
        for i in rng.permutation(20):
            store.get(int(i))
    assert len(decoded) < 0.6 * 400  # no rule can decode fewer than half


def test_a_cache_without_room_keeps_nothing_and_still_works(tmp_path: Path, threads: Callable[[], int]) -> None:
    store = ImageStore(sources(tmp_path, 2), cache_bytes=FRAME - 1)
    store.prefetch([0, 1])
    np.testing.assert_array_equal(store.get(1)[0], truth(1))
    assert store.used_bytes == 0 and threads() == 0


def test_prefetched_frames_equal_decoded_frames(tmp_path: Path, threads: Callable[[], int]) -> None:
    store = ImageStore(sources(tmp_path, 6), cache_bytes=100 * FRAME)
    store.prefetch([3, 1, 3])
    wait(lambda: store.used_bytes == 2 * FRAME)
    (tmp_path / "3.png").unlink()  # it can come only from memory now
    np.testing.assert_array_equal(store.get(3)[0], truth(3))
    store.close()
    assert threads() == 0
    np.testing.assert_array_equal(store.get(0)[0], truth(0))


def test_several_threads_decode_at_once(tmp_path: Path, threads: Callable[[], int], monkeypatch: pytest.MonkeyPatch) -> None:
    together = threading.Barrier(3)

    def meet(source: FrameSource) -> tuple[torch.Tensor, torch.Tensor | None]:
        together.wait(timeout=20)
        return decode(source)

    store = ImageStore(sources(tmp_path, 6), cache_bytes=100 * FRAME)
    monkeypatch.setattr(module, "decode", meet)
    store.prefetch([0, 1, 2], threads=3)
    wait(lambda: store.used_bytes == 3 * FRAME)
    store.prefetch([3, 4, 5])
    wait(lambda: store.used_bytes == 6 * FRAME)
    assert threads() == 3 and all((store.get(i)[0].numpy() == truth(i)).all() for i in range(6))
    store.close()
    assert threads() == 0


@pytest.mark.parametrize("count", [1, 3])
def test_frames_never_depend_on_timing(tmp_path: Path, count: int) -> None:
    store = ImageStore(sources(tmp_path, 12), cache_bytes=5 * FRAME)
    rng = np.random.default_rng(0)
    for _ in range(300):
        store.prefetch(rng.integers(0, 12, 4).tolist(), threads=count)
        i = int(rng.integers(0, 12))
        rgb, mask = store.get(i)
        assert mask is None and torch.equal(rgb, torch.from_numpy(truth(i)))
        assert store.used_bytes <= 5 * FRAME
    store.close()


def test_the_bytes_in_use_never_exceed_the_budget_not_even_within_a_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    class Watched(module._Cache):
        def __setattr__(self, name: str, value: object) -> None:
            super().__setattr__(name, value)
            if name == "used":
                seen.append(value)

    monkeypatch.setattr(module, "_Cache", Watched)
    store = ImageStore(sources(tmp_path, 6), cache_bytes=2 * FRAME)
    for i in [0, 1, 2, 3, 4, 5, 0, 5]:
        store.get(i)
    assert max(seen) == 2 * FRAME and min(seen) == 0


def test_a_lower_limit_holds_from_the_next_frame_on_even_one_that_does_not_fit(tmp_path: Path) -> None:
    store = ImageStore(sources(tmp_path, 4), cache_bytes=3 * FRAME)
    for i in range(3):
        store.get(i)
    store.limit(FRAME // 2)
    np.testing.assert_array_equal(store.get(3)[0], truth(3))
    assert store.used_bytes == 0


def test_a_bad_file_is_reported_by_get_not_by_the_thread(tmp_path: Path) -> None:
    store = ImageStore(sources(tmp_path, 3), cache_bytes=100 * FRAME)
    (tmp_path / "1.png").write_bytes(b"broken")
    store.prefetch([1, 2])
    wait(lambda: store.used_bytes == FRAME)
    with pytest.raises(InputError, match=r"1\.png"):
        store.get(1)
    store.close()


def test_a_deleted_store_ends_its_thread(tmp_path: Path, threads: Callable[[], int]) -> None:
    store = ImageStore(sources(tmp_path, 3), cache_bytes=100 * FRAME)
    store.prefetch([0])
    gone = weakref.ref(store)
    assert threads() == 1
    del store
    gc.collect()
    assert gone() is None and threads() == 0


@pytest.mark.slow
def test_exit_while_busy_is_quiet_and_quick(tmp_path: Path) -> None:
    for i in range(40):
        Image.fromarray(np.random.default_rng(i).integers(0, 256, (300, 300, 3)).astype(np.uint8)).save(tmp_path / f"{i}.png")
    code = f"""
from pathlib import Path
from scene_experts.data.images import FrameSource, decode
from scene_experts.data.lens import Lens
from scene_experts.data.store import ImageStore
lens = Lens("PINHOLE", 300, 300, (200.0, 200.0, 150.0, 150.0))
store = ImageStore([FrameSource(Path({str(tmp_path)!r}) / f"{{i}}.png", lens, (300, 300)) for i in range(40)], 1 << 30)
store.prefetch(range(40))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=400)
    assert done.returncode == 0 and done.stderr == ""


def test_available_memory_is_plausible() -> None:
    free = available_bytes()
    assert free is not None and 1 << 20 < free < 1 << 50
    assert ImageStore([]).cache_bytes > 1 << 20


def test_available_memory_counts_the_containers_limit_and_its_files_as_free(monkeypatch: pytest.MonkeyPatch) -> None:
    group = "/sys/fs/cgroup/"
    files = {
        "/proc/meminfo": "MemTotal: 100 kB\nMemAvailable: 8388608 kB\n",
        f"{group}memory.max": f"{3 * 2**30}\n",
        f"{group}memory.current": f"{3 * 2**30}\n",
        f"{group}memory.stat": f"anon 5\ninactive_file {2**29}\n",
    }

    def read(path: Path | str) -> str:
        if str(path) not in files:
            raise FileNotFoundError(path)
        return files[str(path)]

    monkeypatch.setattr(module, "_read", read)
    assert available_bytes() == 2**29, "pages of files count as free"
    del files[f"{group}memory.stat"]
    assert available_bytes() == 0 and ImageStore([]).cache_bytes == 0
    files[f"{group}memory.max"] = "max\n"
    assert available_bytes() == 2**33
    files.clear()
    monkeypatch.setattr(module.os, "sysconf_names", {})
    assert available_bytes() is None and ImageStore([]).cache_bytes == (4 << 30) // 3
