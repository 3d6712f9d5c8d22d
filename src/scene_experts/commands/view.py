"""`scene-experts view`: a trained scene in a browser."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, parse
from scene_experts.commands import PROG
from scene_experts.core.choices import Device, Raster


@dataclass(frozen=True)
class ViewCommand:
    """Show a run or a file in a browser. The pictures are rendered on this machine, so the browser
    needs no GPU."""

    run: Annotated[Path, Option(value="RUN")]
    """Run folder, or a file or result folder of any format that `import` reads; that needs no
    capture."""
    port: int = 8080
    """Port to listen on."""
    host: str = "127.0.0.1"
    """Address to listen on. 0.0.0.0 accepts other machines that know the token in the printed
    address."""
    data: Annotated[Path | None, Option(short="-s", value="CAPTURE")] = None
    """Folder of the capture, if a run's has moved, or that of a file."""
    step: int | None = None
    """Iteration of the checkpoint to show; by default the newest."""
    device: Device = "auto"
    """Device to render on. auto: CUDA if available."""
    rasterizer: Raster = "auto"
    """Rasteriser. auto: the fastest that works on the device."""


def view(args: list[str]) -> int:
    command = parse(ViewCommand, Command(f"{PROG} view", ("run",)), args)

    from scene_experts.api.backend import backend
    from scene_experts.files.lone import open_scene
    from scene_experts.files.placed import PHOTOGRAPHED
    from scene_experts.render import as_trained
    from scene_experts.training import run_folder
    from scene_experts.view.gate import is_local
    from scene_experts.view.server import Viewer, check_host, check_port, import_viser

    check_port(command.port)
    check_host(command.host)
    import_viser()  # reports a missing package before anything is read
    device, rasterize = backend(command.device, command.rasterizer, False, False)
    opened = open_scene(command.run, device, command.step, command.data)
    rasterize = as_trained(rasterize, opened.config.train.antialias)
    capture = run_folder.capture_of(opened, command.data)
    label = capture.name if opened.cameras is not None else f"{opened.config.train.recipe} on {capture.name}"
    viewer = Viewer(
        capture,
        lambda: (opened.scene, opened.step),
        rasterize,
        command.host,
        command.port,
        label,
        paths=opened.path / "paths",
        draws=opened.scene.frozen(opened.step),
    )
    if opened.cameras is not None:
        viewer.panel.wipe.visible = False
        viewer.panel.near.value = viewer.panel.near.visible = opened.cameras.kind == PHOTOGRAPHED
    if viewer.moved:
        print(f"warning: port {command.port} is taken, the scene is shown on another", file=sys.stderr)
    if not is_local(command.host):
        print(
            "warning: other machines can reach this viewer. It serves those that know the token in the address below; the connection is "
            "not encrypted, so use it in networks that you trust",
            file=sys.stderr,
        )
    print(f"{label}: {viewer.url} (Ctrl-C to stop)", flush=True)
    try:
        viewer.serve()
    finally:
        viewer.close()
        capture.images.close()
    return 0
