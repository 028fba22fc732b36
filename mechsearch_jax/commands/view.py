"""`mechsearch view`: a recorded episode in the browser."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Annotated

import tyro

from mechsearch_jax.commands.video import FPS, check_option, check_pace, recording_of


def view(
    episode: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    /,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    fps: int = FPS,
    speed: float = 1.0,
) -> None:
    """Show an episode in the browser from its recording: the robot, what was believed, and every decision.

    Args:
      episode: folder of `search --record` or `search --video`.
      host: address that is listened at; 0.0.0.0 is every one of this machine, for browsers on others.
      port: of the page; the next free one where it is taken.
      fps: moments in a second.
      speed: how many times as fast as it was everything goes.
    """
    from rich.console import Console

    from mechsearch_jax.viz.web import import_viser

    check_option("view", "port", port, 1, 65535)
    check_pace("view", fps, speed)
    viser = import_viser()
    recording = recording_of(episode)
    from mechsearch_jax.envs.recording.viewer import Viewer
    from mechsearch_jax.problem.cache import keep_compilations

    keep_compilations()
    console = Console(highlight=False)
    with console.status("preparing"):
        # It would tell its address before there is anything to be seen.
        with contextlib.redirect_stdout(io.StringIO()):
            server = viser.ViserServer(host, port, label=recording.heading, verbose=False)
        viewer = Viewer(recording, server, fps, speed)
    shown = "localhost" if host in ("127.0.0.1", "0.0.0.0") else host
    console.print(f"http://{shown}:{server.get_port()}  (Ctrl-C ends it)", soft_wrap=True)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            viewer.run()
    finally:
        server.stop()
