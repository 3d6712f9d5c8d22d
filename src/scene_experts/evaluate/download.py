"""Downloads the published LPIPS weights, on request only."""

from __future__ import annotations

from scene_experts.data.fetch.download import Progress, fetch
from scene_experts.evaluate import weights

TORCHVISION = "https://download.pytorch.org/models"
LPIPS = "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/082bb24f84c091ea94de2867d34c4544f68e0963/lpips/weights/v0.1"


def lpips(net: str, *, backbones: str = TORCHVISION, linears: str = LPIPS, progress: Progress | None = None) -> str:
    """Fetch backbone (vgg 528 MB, alex 233 MB) and linear layers of `net`, keep the 59 or 10 MB needed; a line on where they lie.

    Files whose content is right already are not fetched again. Raises RunError when the network or the content fails.
    """
    folder = weights.cache_dir()
    for base, (name, digest) in ((backbones, weights.BACKBONE[net]), (linears, weights.LINEAR[net])):
        fetch([f"{base}/{name}"], folder / name, digest, progress=progress, advice="give --lpips-weights")
    _, what = weights.load(net)
    if weights.cache_file(net).is_file():  # the tensors we need are kept there
        (folder / weights.BACKBONE[net][0]).unlink(missing_ok=True)
    return what
