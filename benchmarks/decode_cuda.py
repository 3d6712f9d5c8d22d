"""Time the decode of an anchor scene on a GPU, forward and backward: Triton kernels and plain torch, in one process.

    python benchmarks/decode_cuda.py [--anchors 100000]

Every decoder gets the same anchors, camera and upstream gradients. Times are medians of interleaved runs between CUDA events, without the
compilation of the Triton kernels. `of the copy` is the bandwidth of the minimum traffic (every input read once and every output written
once per direction) in that time, divided by the bandwidth of a plain device copy measured in the same run.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from statistics import median

import torch

from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded
from scene_experts.native.triton import explain_missing
from scene_experts.scene.anchors import triton_networks
from scene_experts.scene.anchors.experts import Experts
from scene_experts.scene.anchors.mlp import Plain
from scene_experts.scene.anchors.scene import Anchors, AnchorScene

SPARSE = 1_000_000  # an iteration after the dense phase
WARM_UP = 3  # first rounds, which compile and do not count
KINDS = {
    "one network": Anchors(decoder=Plain()),
    "Top-2 of 5": Anchors(decoder=Experts(num=5, top_k=2)),
    "dense 5": Anchors(decoder=Experts(num=5, top_k=None)),
}
GAUSSIAN = 4 * (3 + 4 + 3 + 1 + 3) + 8  # bytes of one drawn Gaussian with its source


def compute_least_bytes(total: int, anchors: int, drawn: int, F: int, K: int, experts: int) -> tuple[int, int]:
    """Minimum traffic of the forward and of the backward pass in bytes: N rows of which A are visible, M Gaussians drawn, without weights.

    The forward pass reads row, position, feature and log-scaling of each anchor and the offset of each Gaussian, and writes raw opacities,
    gates of three attributes and the Gaussians. The backward pass also reads their gradients, and writes the gradients of all N rows.
    """
    inputs = anchors * (8 + 12 + 4 * F + 24) + drawn * 12
    gates = 0 if experts == 1 else 3 * 4 * experts
    forward = inputs + anchors * (4 * K + gates) + drawn * GAUSSIAN
    backward = inputs + 2 * (anchors * (4 * K + gates) + drawn * (GAUSSIAN - 8)) + total * 4 * (F + 6 + 3 * K)
    return forward, backward


@dataclass
class Case:
    """One decoder in one form, with its times in ms."""

    scene: AnchorScene
    rows: torch.Tensor
    camera: Camera
    form: str
    forward: list[float] = field(default_factory=list)
    backward: list[float] = field(default_factory=list)
    drawn: int = 0
    upstream: list[torch.Tensor] = field(default_factory=list)

    def run(self) -> None:
        """Time one forward and one backward pass."""
        self.scene.zero_grad(set_to_none=True)
        self.scene.config = replace(self.scene.config, decode=self.form)  # type: ignore[arg-type]
        kept: list[list[torch.Tensor]] = []
        self.forward.append(time_on_device(lambda: kept.append(list_outputs(self.scene.decode(self.rows, self.camera, SPARSE)))))
        values = kept[0]
        self.drawn = len(values[0])
        if not self.upstream:
            torch.manual_seed(1)
            self.upstream = [torch.randn_like(v) for v in values]
        self.backward.append(time_on_device(lambda: torch.autograd.backward(values, self.upstream)))


def list_outputs(decoded: Decoded) -> list[torch.Tensor]:
    g = decoded.gaussians
    raw = [] if decoded.raw_opacity is None else [decoded.raw_opacity]
    return [g.means, g.quats, g.scales, g.opacities, g.colors, *raw, *(r.gates for r in decoded.routing.values())]


def time_on_device(work: Callable[[], object]) -> float:
    """Milliseconds of `work` on the device."""
    begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    torch.cuda.synchronize()
    begin.record()
    work()
    end.record()
    end.synchronize()
    return begin.elapsed_time(end)


def make_scene(config: Anchors, total: int, device: str) -> AnchorScene:
    """Random anchors with features like trained ones."""
    torch.manual_seed(0)
    params = {
        "feature": 0.5 * torch.randn(total, config.F),
        "offsets": 0.3 * torch.randn(total, config.K, 3),
        "log_scaling": 0.3 * torch.randn(total, 6) - 3,
    }
    made = AnchorScene(config, Table(params, {"xyz": torch.randn(total, 3), "cell": torch.zeros(total, 3, dtype=torch.int64)}), 0.01, 5.0)
    return made.to(device)


def measure_copy_bandwidth(rounds: int, mebibytes: int = 512) -> float:
    """Bytes per second that a plain copy of so much memory reads and writes."""
    source = torch.empty(mebibytes * 2**18, device="cuda")
    to = torch.empty_like(source)
    times = [time_on_device(lambda: to.copy_(source)) for _ in range(rounds + WARM_UP)]
    return 2 * mebibytes * 2**20 / (1e-3 * median(times[WARM_UP:]))


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anchors", type=int, default=100_000, help="anchors that the camera sees")
    parser.add_argument("--seen", type=float, default=0.7, help="share of the table that it sees")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--copy", type=int, default=512, metavar="MIB", help="size of the copy that measures the bandwidth")
    parser.add_argument("--forms", nargs="+", default=["composed", "native"], choices=("composed", "native"), help="torch, Triton")
    parser.add_argument("--precision", choices=("ieee", "tf32x3", "tf32"), default="ieee", help="of the kernels' products")
    return parser


def main() -> None:
    args = make_parser().parse_args()
    if not torch.cuda.is_available() or explain_missing() is not None:
        raise SystemExit(explain_missing() or "expected a CUDA device, found none; run this on a machine with one")
    triton_networks.PRECISION = args.precision
    pose = torch.eye(4)
    pose[2, 3] = 6.0
    camera = Camera(pose, torch.eye(3), 800, 544).to("cuda")
    total = int(args.anchors / args.seen)
    rows = torch.randperm(total)[: args.anchors].sort().values.cuda()
    cases: dict[tuple[str, str], Case] = {}
    for kind, config in KINDS.items():
        for form in args.forms:  # on CUDA "native" is Triton
            cases[kind, form] = Case(make_scene(config, total, "cuda"), rows, camera, form)
    for case in (c for _ in range(args.rounds + WARM_UP) for c in cases.values()):
        case.run()
    copy = measure_copy_bandwidth(args.rounds, args.copy)
    name = torch.cuda.get_device_name()
    print(f"{name}, {args.anchors} of {total} anchors, K = 10, F = 32, {args.precision}; a copy moves {copy / 1e9:.0f} GB/s")
    print("\n".join(format_report(cases, total, args.anchors, copy)))


def format_report(cases: dict[tuple[str, str], Case], total: int, anchors: int, copy: float) -> list[str]:
    """One line per case; copy: bytes per second."""
    lines = []
    for (kind, form), case in cases.items():
        forward, backward = median(case.forward[WARM_UP:]), median(case.backward[WARM_UP:])
        config, other = case.scene.config, cases.get((kind, "composed"))
        experts = config.decoder.num if isinstance(config.decoder, Experts) else 1
        least = compute_least_bytes(total, anchors, case.drawn, config.F, config.K, experts)
        shares = [100 * b / (1e-3 * t) / copy for b, t in zip(least, (forward, backward))]
        ratio = f"{(median(other.forward[WARM_UP:]) + median(other.backward[WARM_UP:])) / (forward + backward):5.2f}" if other else "-"
        lines.append(
            f"{'Triton' if form == 'native' else 'torch':7}{kind:12} forward {forward:7.3f} ms ({shares[0]:3.0f} % of the copy), "
            f"backward {backward:7.3f} ms ({shares[1]:3.0f} %), {ratio}x as fast as torch ({case.drawn} drawn)"
        )
    return lines


if __name__ == "__main__":
    main()
