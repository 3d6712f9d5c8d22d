"""A recipe of another package: Scaffold-GS whose decoders are several times as wide.

pip install examples/new_recipe
scene-experts train wide-decoders --data CAPTURE --out RUN --scene.decoder.width 4
"""

from dataclasses import dataclass, replace

from torch import nn

import scene_experts as se
from scene_experts.core.parts import register
from scene_experts.scene.anchors.mlp import Plain


@register
@dataclass(frozen=True)
class WideDecoder(Plain):
    width: int = 2
    """How many times as wide the hidden layers are."""

    def build(self, attribute: str, inputs: int, hidden: int, outputs: int, feature: int) -> nn.Module:
        return super().build(attribute, inputs, self.width * hidden, outputs, feature)


BASE = se.recipe("scaffold-gs")
RECIPE = "Scaffold-GS with wide decoders", replace(BASE, scene=replace(BASE.scene, decoder=WideDecoder()))
