"""Photographs that stay on the device of a training."""

import pytest
import torch

from scene_experts.data.views import Frame
from scene_experts.training.resident import Resident, average
from support.captures import load
from support.depths import make_depths
from support.synthetic import make_blender, make_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory):
    return load(make_capture(tmp_path_factory.mktemp("resident"), views=5, size=(24, 16)).folder)


SIZE = 24 * 16 * 3


def test_a_photograph_is_the_same_kept_or_not(capture) -> None:
    none, two = Resident(capture, "cpu", torch.float32), Resident(capture, "cpu", torch.float32, budget=2 * SIZE)
    for _ in range(2):
        for index in (3, 0, 1):
            rgb, mask = two.see(index)
            assert torch.equal(rgb, capture.frame(index).rgb.float() / 255) and mask is None
            assert torch.equal(none.see(index)[0], rgb)
            rgb.zero_()  # the caller's own
    assert set(two.kept) == {3, 0} and two.used == 2 * SIZE and not none.kept


@pytest.mark.parametrize("shape, by", [((16, 24, 3), 2), ((17, 25, 3), 2), ((13, 9), 4)])
def test_a_smaller_photograph_has_the_means_of_blocks(shape, by) -> None:
    picture = torch.randint(0, 256, shape, dtype=torch.uint8)
    planes = picture.double().view(*shape[:2], -1).permute(2, 0, 1)
    expected = torch.nn.functional.avg_pool2d(planes, by).permute(1, 2, 0).reshape(shape[0] // by, shape[1] // by, *shape[2:])
    torch.testing.assert_close(average(picture.double(), by), expected)
    torch.testing.assert_close(average(picture, by), expected.float())


def test_a_smaller_photograph_has_the_size_of_its_camera(capture) -> None:
    photographs = Resident(capture, "cpu", torch.float32)
    rgb, mask = photographs.see(1, 2)
    small = capture.views[1].camera.shrunk(2)
    assert rgb.shape == (small.height, small.width, 3) and mask is None
    torch.testing.assert_close(rgb, average(photographs.see(1)[0], 2))


def test_pixels_that_do_not_count_colour_no_block() -> None:
    class Masked:
        mask = torch.tensor([[1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]])

        def frame(self, index: int) -> Frame:
            return Frame(torch.tensor([200, 0, 90, 90], dtype=torch.uint8)[None, :, None].expand(2, 4, 3), self.mask)

    rgb, mask = Resident(Masked(), "cpu", torch.float32).see(0, 2)  # type: ignore[arg-type]
    assert mask is not None and mask.tolist() == [[0.5, 0.0]]
    torch.testing.assert_close(rgb[0, 0], torch.full((3,), 200 / 255))
    assert rgb.isfinite().all()


def test_only_photographs_that_are_not_kept_are_decoded_ahead(capture, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(capture.images, "prefetch", lambda indices, threads: asked.append((indices, threads)))
    some = Resident(capture, "cpu", torch.float64, budget=SIZE)
    assert some.see(2)[0].dtype == torch.float64
    some.prefetch([2, 4])
    assert asked == [([4], 1)]


def test_the_background_is_that_of_the_view_or_of_the_capture(capture) -> None:
    photographs = Resident(capture, "cpu", torch.float32)
    assert photographs.background(None) is photographs.background(None)
    assert torch.equal(photographs.background(None), torch.tensor(capture.background))
    assert torch.equal(photographs.background(torch.ones(3)), torch.ones(3))


def test_transparent_photographs_keep_the_colour_that_they_lie_over(tmp_path) -> None:
    capture = load(make_blender(tmp_path).folder, init="random")
    assert capture.alpha_over == capture.background == (1.0, 1.0, 1.0)
    assert torch.equal(Resident(capture, "cpu", torch.float32).background(torch.zeros(3)), torch.ones(3))


def test_depth_maps_stay_while_there_is_room(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = load(make_depths(tmp_path / "planes"))
    some = Resident(capture, "cpu", torch.float64)
    monkeypatch.setattr("scene_experts.training.resident.DEPTHS", 64 * 48 * 8)
    one = some.depth(1)
    assert one is some.depth(1) and one.dtype == torch.float64 and torch.equal(one, capture.depth(1).double())
    assert some.depth(2) is not some.depth(2) and set(some.depths) == {1}


def test_photographs_without_depth_have_none(capture) -> None:
    assert Resident(capture, "cpu", torch.float32).depth(0) is None
