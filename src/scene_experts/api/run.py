"""`Run`: a trained scene to draw, score and export."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_experts.api import checked, recording
from scene_experts.api.backend import Device, Raster, backend
from scene_experts.api.camera import Camera, to_trained
from scene_experts.api.capture import Capture, load_capture
from scene_experts.api.recipe import Recipe
from scene_experts.core import types
from scene_experts.core.errors import InputError, expect_among, expect_words
from scene_experts.evaluate.command import about
from scene_experts.evaluate.options import EvalOptions
from scene_experts.evaluate.photographs import score_training_views
from scene_experts.evaluate.pictures import to_8bit
from scene_experts.evaluate.score import evaluate
from scene_experts.files import export as exporting
from scene_experts.files.export import Options
from scene_experts.files.importing import import_files
from scene_experts.render import Rasterizer, as_trained
from scene_experts.report import page
from scene_experts.scene import Draws, Scene
from scene_experts.scene.anchors.mlp import ATTRIBUTES
from scene_experts.training import run_folder, state
from scene_experts.training.run_folder import OpenRun
from scene_experts.training.state import Training
from scene_experts.view import video
from scene_experts.view.paint import Look, measure_depth, paint
from scene_experts.view.show import SHOWS, Show


@dataclass(frozen=True, eq=False)
class Layers:
    """What a camera sees of a scene."""

    image: NDArray[np.float32]
    """[H, W, 3] RGB in [0, 1], the background blended in."""
    depth: NDArray[np.float32]
    """[H, W] Depth along z, capture's unit: the mean over what is drawn, weighted by contribution;
    0 where nothing is drawn."""
    alpha: NDArray[np.float32]
    """[H, W] Opacity in [0, 1]; the background has the weight 1 - alpha."""


@dataclass(frozen=True)
class Scores:
    """Scores of a run: means over the views of a split."""

    psnr: float
    """Peak signal-to-noise ratio, dB; higher is better."""
    ssim: float
    """Structural similarity, at most 1; higher is better."""
    lpips: float | None
    """Learned perceptual distance (VGG16, pictures in [-1, 1]), at least 0; lower is better. None
    where its weights are not on this machine. `details["lpips_3dgs"]` has it for pictures in [0,
    1], as 3DGS and papers after it compute it."""
    per_view: dict[str, dict[str, Any]]
    """The scores and counts of each view, by the name of its photograph."""
    details: dict[str, Any]
    """Everything that RUN/results.json holds: other variants of the metrics, sizes, expert shares,
    frames a second, versions."""


class Run:
    """A trained scene with its recipe and capture. `train`, `open_run`, `import_run` and
    `Trainer.run` return one."""

    def __init__(
        self,
        opened: OpenRun,
        device: str,
        rasterize: Rasterizer,
        *,
        capture: Capture | None = None,
        data: Path | None = None,
        training: Training | None = None,
    ) -> None:
        """capture: the capture of the run as it was loaded, if it is already. data: its new
        location.  training: the training of a scene in memory."""
        self._opened, self._device, self._given, self._data, self._training = opened, device, capture, data, training
        self._capture: Capture | None = None  # with the cameras of the run
        self._rasterize = as_trained(rasterize, opened.config.train.antialias)
        self._draws: Draws | None = None
        self._averaged: tuple[int, Scene] | None = None  # of a training with averages: the iteration, and the scene at it

    @property
    def path(self) -> Path | None:
        """The run folder; None for a scene that is only in memory."""
        return None if self._training else self._opened.path

    @property
    def recipe(self) -> Recipe:
        """The recipe with the numbers that the scene was trained with."""
        return self._opened.config.train

    @property
    def step(self) -> int:
        """Number of iterations trained so far."""
        return self._training.step if self._training else self._opened.step

    @property
    def seconds(self) -> float:
        """Wall time of these iterations, seconds."""
        return (self._training or self._opened).clock.seconds

    @property
    def scene(self) -> Scene:
        """The scene in the trained world, as the package's own modules use it: a torch module with
        a table of rows.

        A recipe with `average.span` gives it the averaged weights, in memory as in a folder.
        """
        training = self._training
        if training is None:
            return self._opened.scene
        if training.averages is None:
            return training.scene
        if self._averaged is None or self._averaged[0] != training.step:
            self._averaged = training.step, training.averaged_scene()
        return self._averaged[1]

    @property
    def capture(self) -> Capture:
        """The capture that the scene was trained on, its training cameras where the scene has
        refined them. It is loaded on first use.

        Raises:
            InputError: The capture is gone, or has other views than during the training.
                `open_run(..., data=FOLDER)` states where it is.
        """
        given, poses = self._given, self.scene.poses
        if given is not None and poses is None:
            return given
        if self._capture is None or self._training:  # a training moves its cameras
            if given is not None:
                moved = run_folder.at_refined_poses(given.loaded, self.scene)
                self._capture = Capture(given.data, moved, given.seed, given.numbers)
            else:
                config, loaded = self._opened.config, run_folder.capture_of(self._opened, self._data)
                self._capture = Capture(replace(config.data, path=loaded.root), loaded, config.train.seed)
        return self._capture

    @property
    def train_cameras(self) -> list[Camera]:
        """The cameras of the views that the training saw."""
        return self.capture.train_cameras

    @property
    def test_cameras(self) -> list[Camera]:
        """The cameras of the held-out views."""
        return self.capture.test_cameras

    def render(
        self, camera: Camera, show: Show = "picture", *, attribute: Literal["opacity", "cov", "color"] = "color"
    ) -> NDArray[np.float32]:
        """Render the picture that a camera sees.

        Args:
            camera: A camera in the capture's frame; its position may be anywhere.
            show: "picture", or false colours: "depth" (near is light), "alpha", "experts" (a colour
                for each expert), "entropy" (of the gates) or "activation" (share of the Gaussians
                of an anchor that are drawn).
            attribute: The attribute whose experts are shown.

        Returns:
            [H, W, 3] float32, RGB in [0, 1].

        Raises:
            InputError: `show` is unknown, or needs experts that the scene does not have.
        """
        expect_among("show", show, SHOWS)
        expect_among("attribute", attribute, ATTRIBUTES)
        view, background = self._view(camera)
        return numpy(paint(self.scene, view, self.step, self._rasterize, background, Look(show=show, attribute=attribute), self._frozen()))

    @torch.no_grad()
    def render_layers(self, camera: Camera) -> Layers:
        """Render the picture, the depth and the opacity that a camera sees."""
        view, background = self._view(camera)
        decoded = self._frozen()(view, self.step, types.Mode.DRAW, self._rasterize.visible)
        drawn = self._rasterize(decoded.gaussians, view, background)
        depth = measure_depth(drawn) / self.capture.loaded.world.scale
        return Layers(numpy(drawn.image.clamp(0, 1)), numpy(depth), numpy(drawn.alpha.clamp(0, 1)))

    def write_video(
        self, out: str | Path, cameras: Iterable[Camera], *, fps: float = 24.0, show: Show = "picture", quality: int = 8
    ) -> Path:
        """Render cameras to a video or to numbered PNG files.

        Args:
            out: FILE.mp4, .mov, .mkv or .webm (needs `pip install imageio-ffmpeg`), or a
                folder for PNG files.
            cameras: One for each frame, all of one size for a video.
            fps: Frames per second, above 0.
            show: As in `render`.
            quality: Of the video, 1 to 10.

        Returns:
            The path of the video or folder.

        Raises:
            InputError: There is no camera, the cameras differ in size, a value is out of range, or
                the encoder is not installed.
            RunError: The encoder fails, or the disk is full.
        """
        if isinstance(cameras, Camera):
            raise InputError("expected cameras, one for each frame, found a single one; give a list, or use `render` for a picture")
        path, cameras, fps, quality = checked.path("out", out), list(cameras), checked.real("fps", fps), checked.integer("quality", quality)
        if not cameras or not 0 < fps < 1000 or not 1 <= quality <= 10:
            raise InputError(f"expected cameras, fps above 0 and quality from 1 to 10, found {len(cameras)} cameras, {fps} and {quality}")
        if path.suffix and not video.is_video(path) and not path.is_dir():
            raise InputError(f"expected a folder or a file ending in {', '.join(video.VIDEO)}, found {path}; choose one of those")
        frames = (to_8bit(torch.from_numpy(self.render(camera, show))) for camera in cameras)
        if not video.is_video(path):
            video.write_pictures(path, frames)
            return path
        sizes = {(camera.width, camera.height) for camera in cameras}
        if len(sizes) > 1:
            raise InputError(f"expected cameras of one size for a video, found {len(sizes)} sizes; use `Camera.resized`, or give a folder")
        video.write_video(path, frames, fps, quality)
        return path

    def evaluate(
        self,
        views: Literal["test", "train"] = "test",
        *,
        appearance: Literal["rule", "half"] = "rule",
        lpips: bool = True,
        lpips_weights: str | Path | None = None,
        download_lpips: bool = False,
        align_poses: bool = False,
    ) -> Scores:
        """Render the held-out views and score them as 8-bit pictures, as `scene-experts eval` does.

        If the run is in a folder, results.json, per_view.json and the pictures are written there.

        Args:
            views: Which views to score: the held-out ones, or those of the training.
            appearance: For scenes with appearance codes: "rule" draws a held-out view with the code
                that the recipe chooses. "half" fits a code to the left half of each photograph and
                scores the right half.
            lpips: Score LPIPS if its weights are found.
            lpips_weights: Folder or file with these weights. Default: where `scene-experts eval`
                looks for them.
            download_lpips: Download the weights if they are not on this machine.
            align_poses: Move each held-out camera to where its photograph fits the scene best,
                before it is scored. Always done for a run with refined poses.

        Raises:
            InputError: The split has no views, or `views` or `appearance` is unknown.
            RunError: The disk is full.
        """
        options = EvalOptions(views, appearance, lpips, None if lpips_weights is None else Path(lpips_weights), download_lpips, align_poses)
        with self._folder() as folder:
            details = evaluate(self.scene, self.capture.loaded, self._rasterize, folder, options, step=self.step, about=about(self._now()))
            if not options.suffix:  # the report lists all photographs
                score_training_views(self.scene, self.capture.loaded, self._rasterize, folder, self.step)
            per_view = run_folder.read_json(folder / f"per_view{options.suffix}.json", "scores by view")
        return Scores(details["psnr"], details["ssim"], details["lpips"], per_view, details)  # type: ignore[arg-type]

    def export(
        self,
        format: str = "compact",
        out: str | Path | None = None,
        *,
        quality: float = 0.2,
        target_mb: float = 0.0,
        sh_degree: int = 3,
        max_gaussians: int = 0,
        prune: float = 0.0,
        refine: int | None = None,
        frame: Literal["capture", "trained"] = "capture",
        crop: str | None = None,
        floaters: Literal["keep", "remove"] = "keep",
        title: str | None = None,
        cells: int = 256,
        photographs: bool = False,
    ) -> Path:
        """Write the scene to a file that other tools or later runs read.

        Args:
            format: "compact" is one small file of this package, "html" a web page with it that decodes
                its networks, and "streamed-html" such a page that fetches it in parts. "anchors" is
                the Scaffold-GS folder layout. "ply", "compressed-ply", "splat", "spz", "sog", "glb",
                "usd" and "baked-html" (a page with a viewer) are standard files of Gaussians; scenes
                of anchors are baked for them, which takes minutes. "html" of other scenes is that
                page. "mesh" is a PLY or GLB file of coloured triangles.
            out: File or folder; a name without a suffix is a folder. Default: inside the run
                folder.
            quality: compact, html, streamed-html: dB of PSNR that the training views may lose.
            target_mb: compact, html, streamed-html: write a file of at most this many megabytes in place of
                `quality`; 0: any size.
            sh_degree: Standard files: degree of the spherical harmonics, 0 to 3.
            max_gaussians: Standard files: keep this many Gaussians, those that contribute most; 0
                keeps all.
            prune: Standard files: leave out the Gaussians that contribute least, up to this share
                (0 to 1) of all contributions.
            refine: Standard files: iterations that fit the baked Gaussians to pictures of the run;
                0 for none. Default: 200 for up to 20 training views, else 200 to 1000,
                by how far they are from them.
            frame: Standard files: the frame of the capture, or the trained world.
            crop: Standard files: keep what is inside "sphere:RADIUS" (around the point that the
                cameras look at; "1.2x" counts in their distance from it), "sphere:X,Y,Z,RADIUS" or
                "box:X0,Y0,Z0,X1,Y1,Z1", in the units of the capture's poses.
            floaters: Standard files: "remove" leaves out Gaussians that no training photograph
                supports.
            title: html: title of the page. Default: the name of the capture.
            cells: mesh: voxels along its longest side, 8 to 2048.
            photographs: html of a scene with networks: put small photographs into the page.

        Returns:
            The path of the file or folder.

        Raises:
            InputError: The format cannot hold the scene, the run is only in memory, or a value is
                unknown or out of range.
            RunError: The disk is full.
        """
        options = checked.fields(Options, {**locals(), "measure": False})
        expect_words(options)
        folder, opened = self._in_folder("export"), self._opened
        if self._device != "cpu":
            opened = run_folder.open_run(folder, "cpu", self.step)
        opened = run_folder.with_capture(opened, self._data)
        return exporting.export(opened, format, None if out is None else Path(out), options)[0].path

    def report(self) -> Path:
        """Write RUN/report.html, a page with curves, held-out views, experts and the command that
        repeats the run.

        Returns:
            The path of the page.

        Raises:
            InputError: The run is only in memory, or was not evaluated.
        """
        return page.write([self._in_folder("report")])

    def save(self, out: str | Path) -> Run:
        """Write a run that is only in memory to a run folder. Every command accepts the folder, and
        training can resume from it.

        Returns:
            The run in the folder.

        Raises:
            InputError: The run is in a folder already, or `out` holds something else.
            RunError: The disk is full.
        """
        training, folder, config = self._training, checked.path("out", out), self._opened.config
        if training is None:
            raise InputError(f"expected a run in memory to save, found one in {self._opened.path}; copy that folder")
        run_folder.check(folder, config, resume=False)
        with run_folder.held(folder):
            run_folder.prepare(folder, config, resume=False)
            state.save(training, folder / "checkpoints", keep=2)
            given = self._given
            assert given is not None, "a training has its capture"
            recording.export_layout(folder, given.loaded)
        return Run(run_folder.open_run(folder, self._device), self._device, self._rasterize, capture=given)

    def _now(self) -> OpenRun:
        """The run as the package's own modules know it."""
        live = self._training
        return self._opened if live is None else replace(self._opened, scene=self.scene, step=live.step, clock=live.clock)

    def _view(self, camera: Camera) -> tuple[types.Camera, Tensor]:
        """The camera in the trained world and the background, on the run's device."""
        capture = self.capture.loaded
        if not isinstance(camera, Camera):
            raise InputError(f"expected a camera, found {camera!r}; give for example one of `Run.test_cameras`")
        if camera.view >= len(capture.views):
            raise InputError(f"expected a camera of {capture.name}, found view {camera.view} of {len(capture.views)}; use another")
        view = to_trained(camera, capture.world, capture.views[0].camera.near)
        return view.to(self._device), torch.tensor(capture.background, dtype=torch.float32, device=self._device)

    def _frozen(self) -> Draws:
        """The scene prepared for drawing. Unless it is being trained, values that do not depend on
        the camera are computed once."""
        if self._training:
            return self.scene
        if self._draws is None:
            self._draws = self._opened.scene.frozen(self._opened.step)
        return self._draws

    def _in_folder(self, what: str) -> Path:
        if self._training:
            raise InputError(f"expected a run in a folder for `{what}`, found one in memory; call `save(FOLDER)` first")
        path = self._opened.path
        if not (path / "config.json").is_file():
            raise InputError(f"expected the run folder {path}, found none: it was moved or removed; open it where it is now")
        return path

    @contextmanager
    def _folder(self) -> Iterator[Path]:
        """The run folder, or a temporary one for a run in memory."""
        if self._training is None:
            yield self._in_folder("evaluate")
            return
        with tempfile.TemporaryDirectory() as folder:
            yield Path(folder)

    def __reduce__(self) -> NoReturn:
        where = f"open_run({str(self.path)!r})" if self.path else "save(FOLDER), and open_run(FOLDER)"
        raise InputError(f"expected something that can be copied to another process, found a run; use {where} there")

    def __repr__(self) -> str:
        return f"Run({self.recipe.recipe!r}, step {self.step:,}, {len(self.scene.table):,} rows, {self.path or 'in memory'})"


def numpy(tensor: Tensor) -> NDArray[np.float32]:
    return tensor.detach().to("cpu", torch.float32).numpy()


def open_run(
    path: str | Path,
    *,
    step: int | None = None,
    data: str | Path | None = None,
    device: Device = "auto",
    rasterizer: Raster = "auto",
) -> Run:
    """Open a run folder.

    Args:
        path: The folder that `train`, `scene-experts train` or an import wrote.
        step: Which checkpoint to open. Default: the newest whole one.
        data: Where the capture is now, if it moved.
        device: "cpu", "cuda", or "auto" (CUDA if torch finds it and gsplat is installed).
        rasterizer: "cpu" (compiled), "gsplat" (CUDA), "reference" (plain torch, slow), or "auto"
            (the fastest that works on the device).

    Raises:
        InputError: The folder is no run, has no such checkpoint, or the device or rasteriser is not
            available.
    """
    folder, step = checked.path("path", path), None if step is None else checked.integer("step", step, 0)
    where, rasterize = backend(device, rasterizer, False, False)
    return Run(run_folder.open_run(folder, where, step), where, rasterize, data=None if data is None else checked.path("data", data))


def import_run(
    source: str | Path,
    capture: Capture | str | Path,
    out: str | Path,
    *,
    iteration: int | None = None,
    transform: str | Path | None = None,
    device: Device = "auto",
) -> Run:
    """Make a run folder of a published result, or of a file that `Run.export` wrote.

    Args:
        source: Result folder (with point_cloud/iteration_N) of Scaffold-GS, Octree-GS, SAGS or
            3DGS, a compact file, or Gaussians as ply, compressed-ply, splat, spz, sog, glb, usd or
            html.
        capture: The capture that it was trained on, or its folder.
        out: Run folder to write.
        iteration: Which iteration of a result folder. Default: the newest.
        transform: How Gaussians came into the frame of their file, if it is not the capture's:
            nerfstudio's dataparser_transforms.json.
        device: As in `open_run`.

    Raises:
        InputError: The source holds no scene, the capture does not fit it, or `out` holds something
            else.
    """
    known = capture if isinstance(capture, Capture) else load_capture(capture)
    into = checked.path("out", out)
    import_files(Path(source), known.data, into, iteration, None if transform is None else Path(transform))
    return open_run(into, device=device)
