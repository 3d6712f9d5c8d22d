"""What a streamed page shows after a share of its bytes: PSNR to the pictures of the whole scene.

    python benchmarks/streamed_scene.py RUN PAGE

RUN is the run that `export --format streamed-html` wrote PAGE from. The views are held-out views and
the first view of a wide screen; bytes are those of the parts. The last line compares them with the
compact file of the same numbers.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch
from torch import Tensor

from scene_experts.core.reading import budget
from scene_experts.core.reading.source import opening
from scene_experts.files.anchors import compact, layers
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.anchors.read import scene as scene_of
from scene_experts.files.formats import html
from scene_experts.files.measure import Painter, capture_if_there
from scene_experts.files.scene_folder import origin_of, world_of
from scene_experts.training.run_folder import open_run
from scene_experts.view.filled import find_first_views, small

SHARES = (0.05, 0.15, 0.3, 0.5, 0.75, 1.0)
MOST, SIDE, WIDE = 4, 400, 16 / 9  # held-out views; px of the shorter side of the first view; its aspect


def psnr(a: Tensor, b: Tensor) -> float:
    return -10 * math.log10(max(float((a.clamp(0, 1) - b).square().mean()), 1e-10))


def states(page: Path) -> list[tuple[int, AnchorData]]:
    """The bytes that are here, and the scene that is shown then."""
    settings = html.settings_in(page.read_bytes())
    first, plan, *chunks = [page.parent / settings["folder"] / name for name, *_ in settings["parts"]]
    with opening(first, budget.COMPACT) as source:
        base = compact.decode_whole(source.read(), source)
        scene, here = layers.LayeredScene(base, plan.read_bytes(), source), first.stat().st_size
    found = [(here, base.restored())]
    here += plan.stat().st_size
    for chunk in chunks:
        scene.take(chunk.read_bytes())
        here += chunk.stat().st_size
        found.append((here, scene.restored()))
    return found


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.add_argument("run", type=Path)
    parser.add_argument("page", type=Path)
    given = parser.parse_args()
    run, found = open_run(given.run), states(given.page)
    whole, world = found[-1][1], world_of(run)
    world = world.seen_from(origin_of(run, world))
    with capture_if_there(run, needed=True) as capture:
        assert capture is not None
        background = torch.tensor(capture.background)

        def painter(data: AnchorData) -> Painter:
            scene, step = scene_of(run, data, world)
            return Painter.of(scene, step, None, run.config.train.antialias)

        last = painter(whole)
        firsts = find_first_views(capture, lambda camera: last.rasterize(last.gaussians(camera), camera, torch.zeros(3)))
        wide = min(firsts, key=lambda view: abs(math.log(view.camera.width / view.camera.height / WIDE)), default=None)
        cameras = [capture.views[i].camera for i in (capture.test or capture.train)[:MOST]] + ([small(wide.camera, SIDE)] if wide else [])
        wanted = [last.picture(camera, background).clamp(0, 1) for camera in cameras]
        total = found[-1][0]
        print("| share of the bytes | anchors | held-out views, dB | first view, dB |\n|---|---|---|---|")
        for share in SHARES:
            here = [data for size, data in found if size <= share * total + 0.5]
            if not here:
                print(f"| {share:.0%} | 0 | - | - |")
                continue
            drawn = painter(here[-1])
            scores = [psnr(drawn.picture(camera, background), picture) for camera, picture in zip(cameras, wanted)]
            held = scores[: len(scores) - 1] if wide else scores
            print(f"| {share:.0%} | {len(here[-1].columns['xyz']):,} | {sum(held) / len(held):.1f} | {scores[-1]:.1f} |", flush=True)
    print(f"coarse scene {found[0][0]:,} bytes ({found[0][0] / total:.1%}), all parts {total:,} bytes")


if __name__ == "__main__":
    main()
