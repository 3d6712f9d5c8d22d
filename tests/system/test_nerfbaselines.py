"""integrations/nerfbaselines against the interface of nerfbaselines 1.2, whose two names that it needs are replaced here.

`nerfbaselines test-method` itself needs numpy below 2 and an environment of its own: docs/how-to.md.
"""

import importlib.util
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import scene_experts as se
from support.places import ROOT
from support.synthetic import make_capture

FOLDER = ROOT / "integrations" / "nerfbaselines"


class Cameras(SimpleNamespace):
    def __len__(self):
        return len(self.poses)

    def item(self):
        return self

    def __getitem__(self, i):
        return Cameras(**{name: value[i] for name, value in vars(self).items()})


@pytest.fixture
def load(monkeypatch):
    specs, fake = [], ModuleType("nerfbaselines")
    fake.__dict__.update(Method=object, camera_model_to_int=lambda name: {"pinhole": 0}[name], register=specs.append)
    monkeypatch.setitem(sys.modules, "nerfbaselines", fake)
    monkeypatch.setattr(sys, "path", [*sys.path])

    def load(name):
        spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module, specs

    return load


def test_the_method_is_registered_under_a_class_that_exists(load):
    _, (spec,) = load("scene_experts_spec")
    module, _, name = spec["method_class"].partition(":")
    assert (FOLDER / f"{module}.py").is_file() and hasattr(load(module)[0], name)
    assert all(recipe["recipe"] in se.list_recipes() for recipe in spec["presets"].values())


@pytest.mark.slow
def test_a_training_its_checkpoint_and_a_saved_copy_draw_the_same(load, tmp_path):
    module, _ = load("scene_experts_nerfbaselines")
    capture = se.load_capture(
        make_capture(tmp_path / "capture", views=6, size=(48, 32), points=200, mixed_sizes=False).folder, split="none"
    )
    cameras = capture.cameras
    k = [camera.K for camera in cameras]
    dataset = {
        "cameras": Cameras(
            poses=np.stack([np.linalg.inv(camera.world_to_camera)[:3] for camera in cameras]),
            intrinsics=np.array([[m[0, 0], m[1, 1], m[0, 2], m[1, 2]] for m in k]),
            image_sizes=np.array([[camera.width, camera.height] for camera in cameras]),
            camera_models=np.zeros(len(cameras), int),
        ),
        "images": [np.rint(255 * capture.photo(i)).astype(np.uint8) for i in range(len(cameras))],
        "masks": None,
        "points3D_xyz": capture.points[0],
        "points3D_rgb": capture.points[1],
        "metadata": {"background_color": None},
    }
    method = module.SceneExperts(train_dataset=dataset, config_overrides={"recipe": "moe-gs", "iterations": "300"})
    assert method.get_info()["num_iterations"] == 300 and method.get_info()["loaded_step"] is None
    for step in range(3):
        assert method.train_iteration(step)["psnr"] > 0
    drawn = method.render(dataset["cameras"][0])
    assert drawn["color"].shape == (32, 48, 3) and drawn["color"].std() > 0
    method.save(tmp_path / "one")
    method.close()
    loaded = module.SceneExperts(checkpoint=str(tmp_path / "one"))
    assert loaded.get_info()["loaded_step"] == 3
    for name, image in loaded.render(dataset["cameras"][0]).items():
        np.testing.assert_allclose(image, drawn[name], atol=1e-5)
    loaded.save(tmp_path / "two")
    names = [{str(p.relative_to(tmp_path / n)) for p in (tmp_path / n).rglob("*")} for n in ("one", "two")]
    assert names[0] == names[1]
