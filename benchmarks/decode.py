"""Time the decode of an anchor scene, forward and backward: compiled and plain torch, one network and a mixture, in one process.

    OMP_NUM_THREADS=1 python benchmarks/decode.py [--anchors 20000]

Every decoder gets the same anchors, directions and upstream gradients. Times are minima of interleaved runs in CPU time of this process
(all its threads). Ratios are to one network per attribute in plain torch (Scaffold-GS as published) in the same run.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import torch

from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded
from scene_experts.native import library as native
from scene_experts.scene.anchors.experts import Experts
from scene_experts.scene.anchors.mlp import Plain
from scene_experts.scene.anchors.scene import Anchors, AnchorScene

SPARSE = 1_000_000  # an iteration after the warm-up


def make_scene(config: Anchors, anchors: int, seen: float) -> tuple[AnchorScene, torch.Tensor]:
    """Random anchors with features like trained ones, and the rows that a camera sees."""
    torch.manual_seed(0)
    total = int(anchors / seen)
    params = {
        "feature": 0.5 * torch.randn(total, config.F),
        "offsets": 0.3 * torch.randn(total, config.K, 3),
        "log_scaling": 0.3 * torch.randn(total, 6) - 3,
    }
    facts = {"xyz": torch.randn(total, 3), "cell": torch.zeros(total, 3, dtype=torch.int64)}
    rows = torch.randperm(total)[:anchors].sort().values
    return AnchorScene(config, Table(params, facts), 0.01, 5.0), rows


def list_outputs(decoded: Decoded) -> list[torch.Tensor]:
    g = decoded.gaussians
    raw = [] if decoded.raw_opacity is None else [decoded.raw_opacity]
    return [g.means, g.quats, g.scales, g.opacities, g.colors, *raw, *(r.gates for r in decoded.routing.values())]


class Case:
    def __init__(self, config: Anchors, form: str, anchors: int, seen: float, camera: Camera) -> None:
        self.scene, self.rows = make_scene(replace(config, decode=form), anchors, seen)  # type: ignore[arg-type]
        self.camera = camera
        self.upstream: list[torch.Tensor] = []
        self.forward = self.both = float("inf")
        self.drawn = 0

    def run(self) -> None:
        self.scene.zero_grad(set_to_none=True)
        began = time.process_time()
        decoded = self.scene.decode(self.rows, self.camera, SPARSE)
        between = time.process_time()
        values = list_outputs(decoded)
        if not self.upstream:
            self.upstream = [torch.randn_like(v) for v in values]
            self.drawn = len(decoded.gaussians)
        again = time.process_time()
        torch.autograd.backward(values, self.upstream)
        backward = time.process_time() - again
        self.forward = min(self.forward, between - began)
        self.both = min(self.both, between - began + backward)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anchors", type=int, default=20_000)
    parser.add_argument("--seen", type=float, default=0.7, help="share of the table that the camera sees")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--only", default="", help="run only the cases whose name contains this text")
    parser.add_argument("--level", choices=native.LEVELS, help="instruction set of the library (default: the best of this processor)")
    args = parser.parse_args()
    if args.level:
        native.list_levels = lambda: (args.level,)
    if native.load() is None:
        raise SystemExit(native.explain_missing())
    pose = torch.eye(4)
    pose[2, 3] = 6.0
    camera = Camera(pose, torch.eye(3), 800, 544)
    one, top2 = Anchors(decoder=Plain()), Anchors(decoder=Experts(num=5, top_k=2))
    dense = Anchors(decoder=Experts(num=5, top_k=None))
    kinds = {
        "torch, one network": (one, "composed"),
        "torch, Top-2 of 5": (top2, "composed"),
        "native, one network": (one, "native"),
        "native, Top-2 of 5": (top2, "native"),
        "native, Top-1 of 5": (Anchors(decoder=Experts(num=5, top_k=1)), "native"),
        "native, dense 5": (dense, "native"),
    }
    cases = {name: Case(*kind, args.anchors, args.seen, camera) for name, kind in kinds.items() if args.only in name}
    for _ in range(args.rounds):
        for case in cases.values():
            case.run()
    print(f"{args.anchors} anchors, K = 10, F = 32, {torch.get_num_threads()} threads, {native.load().level}")  # type: ignore[union-attr]
    base = cases.get("torch, one network")
    for name, case in cases.items():
        ratio = f"{case.both / base.both:5.2f}x" if base else ""
        print(f"{name:20} forward {1e3 * case.forward:6.1f} ms, forward + backward {1e3 * case.both:6.1f} ms {ratio} ({case.drawn} drawn)")
    if not args.only:
        print(f"native Top-2 / native one network: {cases['native, Top-2 of 5'].both / cases['native, one network'].both:.2f}x")


if __name__ == "__main__":
    main()
