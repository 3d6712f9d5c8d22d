"""The peer of `train_cuda.py`: a fixed number of explicit Gaussians (Kerbl et al. 2023), trained by a minimal loop over gsplat.

    python benchmarks/explicit_gsplat.py --data CAPTURE --count 857293 --out DIR --seconds 100       # in slices, as train_cuda.py

Its loss, Adam and copies to the device are those of commit da16e27 (`peer_cuda`). `--loss torch` takes torch's convolutions for SSIM, as
many trainers do; no ratio is formed with it. A finished peer is found again by its count and loss.
"""

from __future__ import annotations

import argparse
import importlib
import math
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from peer_cuda.adam import Adam
from peer_cuda.device import upload, upload_camera
from peer_cuda.loss import photometric
from scene_experts.core import checkpoint
from scene_experts.core.types import Camera
from scene_experts.data.capture import Capture, load
from scene_experts.data.settings import Data
from scene_experts.geometry.neighbours import knn_d2
from scene_experts.geometry.sh import rgb_to_dc

LOSSES = ("triton", "torch")
Draw = Callable[[dict[str, Tensor], Camera, int, Tensor], Tensor]
RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "dc": 2.5e-3, "rest": 2.5e-3 / 20}  # 3DGS's
DEGREE_EVERY = 1000  # iterations between degrees of the harmonics


def draw(p: dict[str, Tensor], camera: Camera, degree: int, background: Tensor) -> Tensor:
    """Render an image [H, W, 3] with gsplat's `rasterization`."""
    picture, _, _ = importlib.import_module("gsplat").rasterization(
        p["means"],
        p["quats"],  # normalised inside
        p["scales"].exp(),
        p["opacities"].sigmoid(),
        torch.cat([p["dc"], p["rest"]], dim=1),
        camera.world_to_cam[None],
        camera.K[None],
        camera.width,
        camera.height,
        near_plane=camera.near,
        sh_degree=degree,
        packed=False,
        backgrounds=background[None],
    )
    return picture[0]


def initialise(capture: Capture, count: int) -> dict[str, Tensor]:
    """Sample `count` Gaussians from the capture's points. Repeated points are jittered by the distance to their neighbours."""
    assert capture.points is not None
    g = torch.Generator().manual_seed(0)
    xyz, rgb = capture.points.xyz, capture.points.rgb.float() / 255
    spacing = knn_d2(xyz.double()).clamp_min(1e-7).sqrt().float()
    chosen = torch.randperm(len(xyz), generator=g)[:count]
    again = torch.randint(len(xyz), (count - len(chosen),), generator=g)
    means = torch.cat([xyz[chosen].float(), xyz[again].float() + spacing[again, None] * torch.randn(len(again), 3, generator=g)])
    source = torch.cat([chosen, again])
    return {
        "means": means,
        "scales": spacing[source].log()[:, None].repeat(1, 3),
        "quats": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        "opacities": torch.full((count,), math.log(0.1 / 0.9)),
        "dc": rgb_to_dc(rgb[source])[:, None],
        "rest": torch.zeros(count, 15, 3),
    }


class Training:
    """The state of the loop, with checkpoints in a folder."""

    def __init__(
        self, capture: Capture, count: int, iterations: int, folder: Path, device: str, draw: Draw = draw, loss: str = "triton"
    ) -> None:
        self.capture, self.count, self.iterations, self.folder, self.device, self.draw = capture, count, iterations, folder, device, draw
        self.loss = loss
        self.step, self.seconds = 0, 0.0
        self.views = torch.Generator().manual_seed(0)
        self.queue: list[int] = []
        newest = checkpoint.latest(folder)
        tensors, meta = checkpoint.load(newest) if newest else (initialise(capture, count), {})
        self.params = {name: tensors[name].to(device).requires_grad_() for name in RATES}
        self.optimizer = Adam([{"params": [p], "name": name, "lr": RATES[name]} for name, p in self.params.items()])
        if newest:
            self.step, self.seconds, self.queue = int(meta["step"]), float(meta["seconds"]), list(meta["queue"])
            self.views.set_state(tensors["views"])
            for name, p in self.params.items():
                keys = [key for key in ("step", "exp_avg", "exp_avg_sq") if f"{name}.{key}" in tensors]
                self.optimizer.state[p] = {key: tensors[f"{name}.{key}"].to(device) for key in keys}

    def save(self) -> None:
        state = {f"{name}.{key}": v for name, p in self.params.items() for key, v in self.optimizer.state.get(p, {}).items()}
        tensors = {name: p.detach() for name, p in self.params.items()} | state | {"views": self.views.get_state()}
        checkpoint.save(self.folder, self.step, tensors, {"step": self.step, "seconds": self.seconds, "queue": self.queue}, keep=1)

    def run(self, deadline: float) -> bool:
        """Train until `deadline` (time.monotonic) or the end; saves. Returns whether it is finished."""
        while self.step < self.iterations and time.monotonic() < deadline:
            began = time.perf_counter()
            self.iterate()
            self.seconds += time.perf_counter() - began
        if self.step:
            if self.device == "cuda":
                torch.cuda.synchronize()
            self.save()
        return self.step == self.iterations

    def iterate(self) -> None:
        """One iteration: view, image, loss, gradient, Adam."""
        self.step += 1
        progress = self.step / self.iterations
        self.optimizer.param_groups[0]["lr"] = RATES["means"] * self.capture.extent * 0.01**progress
        while len(self.queue) < 4:
            self.queue += [self.capture.train[i] for i in torch.randperm(len(self.capture.train), generator=self.views).tolist()]
        index = self.queue.pop(0)
        frame = self.capture.frame(index)
        self.capture.images.prefetch(self.queue[:3])
        target = upload(frame.rgb, self.device, torch.float32).div_(255.0)
        mask = None if frame.mask is None else upload(frame.mask, self.device)
        image = self.render(self.capture.views[index].camera)
        l1, dssim = photometric(image, target, 0.2, mask, self.loss)
        (l1 + dssim).backward()
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    def render(self, camera: Camera) -> Tensor:
        degree = min(3, self.step // max(1, round(DEGREE_EVERY * self.iterations / 30_000)))
        background = upload(torch.tensor(self.capture.background), self.device)
        return self.draw(self.params, upload_camera(camera, self.device), degree, background)


def start(capture: Capture, count: int, iterations: int, out: Path, device: str, draw: Draw = draw, loss: str = "triton") -> Training:
    """Begin or continue a training in its own folder of `out`, after one step that compiles all kernels."""
    if device == "cuda":
        Training(capture, 1000, 20, out / "unused", device, draw, loss).iterate()
        torch.cuda.reset_peak_memory_stats()
    folder = out / (f"explicit-{count}" if loss == "triton" else f"explicit-{count}-{loss}")
    return Training(capture, count, iterations, folder, device, draw, loss)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="a capture")
    parser.add_argument("--count", type=int, required=True, help="number of Gaussians")
    parser.add_argument("--out", type=Path, required=True, help="folder of the checkpoint, kept between slices")
    parser.add_argument("--iterations", type=int, default=30_000)
    parser.add_argument("--resolution", default="auto")
    parser.add_argument("--seconds", type=float, default=500.0, help="length of this slice")
    parser.add_argument("--loss", default="triton", choices=LOSSES)
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    args = parser.parse_args(argv)
    deadline = time.monotonic() + args.seconds
    capture = load(Data(args.data, resolution=args.resolution))
    made = start(capture, args.count, args.iterations, args.out, args.device, loss=args.loss)
    finished = made.run(deadline)
    capture.images.close()
    each = f", {1e3 * made.seconds / made.step:.2f} ms each" if made.step else ""
    print(f"{args.count:,} Gaussians, {args.loss} loss: {made.step} iterations{each}")
    print("all done" if finished else "to do: the rest; run the same command again")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
