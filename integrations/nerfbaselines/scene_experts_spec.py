"""Registers scene-experts with nerfbaselines: set NERFBASELINES_REGISTER to the path of this file.

The folder of this file goes on the path, so that nerfbaselines finds the method's class. See docs/how-to.md.
"""

import sys
from pathlib import Path

from nerfbaselines import register

sys.path.insert(0, str(Path(__file__).parent))

register(
    {
        "id": "scene-experts",
        "method_class": "scene_experts_nerfbaselines:SceneExperts",
        "backends_order": ["python"],
        "conda": {
            "environment_name": "scene-experts",
            "python_version": "3.11",
            "install_script": "pip install 'torch>=2.7' 'numpy<2' scene-experts\n",
        },
        "metadata": {
            "name": "Scene Experts",
            "description": "Anchor-based 3D Gaussian splatting with a mixture of expert decoders, and its anchor-based baselines.",
            "paper_title": "Scene Experts: Specializing in 3D Gaussian Splatting with Adaptive Decomposition",
            "licenses": [{"name": "Apache 2.0", "url": "https://www.apache.org/licenses/LICENSE-2.0"}],
        },
        "presets": {
            "moe-gs": {"recipe": "moe-gs"},
            "scaffold-gs": {"recipe": "scaffold-gs"},
            "octree-gs": {"recipe": "octree-gs"},
        },
        "implementation_status": {},
    }
)
