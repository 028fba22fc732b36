"""`mechsearch video` and `mechsearch view`: a recorded episode as a film, in the browser, and as a page."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mechsearch_jax.runtime.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from mechsearch_jax.envs.recording.recording import Recording

WIDTH, FPS = 960, 15
# Largest width [pixels] and rate [frames/s].
WIDEST, FASTEST = 3840, 60


def video(
    episode: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="FILE.mp4|FILE.webp")],
    width: int = WIDTH,
    fps: int = FPS,
    speed: float = 1.0,
) -> None:
    """Make the film of an episode from its recording: the robot acting, the map of f and g, what the camera saw.

    Args:
      episode: folder of `search --record` or `search --video`.
      out: the film; its ending says what it is, H.264 or an animated WebP for a page.
      width: of the film [pixels].
      fps: pictures in a second.
      speed: how many times as fast as it was everything goes.
    """
    from rich.console import Console

    from mechsearch_jax.problem.cache import keep_compilations
    from mechsearch_jax.runtime.files import check_writable
    from mechsearch_jax.viz.movie import check_movie_path

    check_option("video", "width", width, 320, WIDEST)
    check_pace("video", fps, speed)
    check_movie_path(out)
    recording = recording_of(episode)
    check_writable(out.parent)
    keep_compilations()
    make_film(recording, out, Console(highlight=False), width, fps, speed)


def view(
    episode: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    /,
    *,
    save: Annotated[Path | None, tyro.conf.arg(metavar="FILE.html", help_behavior_hint="")] = None,
    film: Annotated[Path | None, tyro.conf.arg(metavar="FILE.mp4|FILE.webp", help_behavior_hint="")] = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    fps: int = FPS,
    speed: float = 1.0,
) -> None:
    """Show an episode in the browser from its recording: the robot, what was believed, and every decision.

    Args:
      episode: folder of `search --record` or `search --video`.
      save: instead write a page of every step's pictures and values, one file that needs no server.
      film: make the film, too, and show it in the page of --save; it stays a file of its own beside the page.
      host: address that is listened at; 0.0.0.0 is every one of this machine, for browsers on others.
      port: of the page; the next free one where it is taken.
      fps: moments in a second.
      speed: how many times as fast as it was everything goes.
    """
    from rich.console import Console

    from mechsearch_jax.viz.web import import_viser

    check_option("view", "port", port, 1, 65535)
    check_pace("view", fps, speed)
    if save is not None:
        return _save_page(episode, save, film, fps, speed)
    if film is not None:
        raise InputError("view: --film is shown in a page; give --save, too, or make it alone by mechsearch video")
    viser = import_viser()
    recording = recording_of(episode)
    from mechsearch_jax.envs.viewer.viewer import Viewer
    from mechsearch_jax.problem.cache import keep_compilations

    keep_compilations()
    console = Console(highlight=False)
    with console.status("preparing"):
        # It would tell its address before there is anything to be seen.
        with contextlib.redirect_stdout(io.StringIO()):
            server = viser.ViserServer(host, port, label=recording.heading, verbose=False)
        viewer = Viewer.of(recording, server, fps, speed)
    shown = "localhost" if host in ("127.0.0.1", "0.0.0.0") else host
    console.print(f"http://{shown}:{server.get_port()}  (Ctrl-C ends it)", soft_wrap=True)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            viewer.run()
    finally:
        server.stop()


def _save_page(episode: Path, path: Path, film: Path | None, fps: int, speed: float) -> None:
    """Write the page of an episode's folder, and its film if one is named."""
    from rich.console import Console

    from mechsearch_jax.envs.page.page import check_page_path
    from mechsearch_jax.problem.cache import keep_compilations
    from mechsearch_jax.runtime.files import check_writable
    from mechsearch_jax.viz.movie import check_movie_path

    check_page_path(path)
    if film is not None:
        check_movie_path(film)
        check_writable(film.parent)
    recording = recording_of(episode)
    check_writable(path.parent)
    keep_compilations()
    console = Console(highlight=False)
    if film is not None:
        make_film(recording, film, console, fps=fps, speed=speed)
    make_page(recording, path, console, film)


def check_option(command: str, name: str, value: float | int, least: float | int, most: float | int) -> None:
    """Check a value of an option.

    Raises:
      InputError: it is out of bounds.
    """
    if not least <= value <= most:
        raise InputError(f"{command}: --{name} {value} is not between {least} and {most}")


def check_pace(command: str, fps: int, speed: float | int) -> None:
    """Check the frame rate and the speed.

    Raises:
      InputError: one is out of bounds.
    """
    check_option(command, "fps", fps, 1, FASTEST)
    check_option(command, "speed", speed, 0.1, 20)


def recording_of(episode: Path) -> Recording:
    """The recording in an episode's folder.

    Raises:
      InputError: there is no recording, or it cannot be read.
    """
    from mechsearch_jax.envs.recording.recording import NAME, load_recording
    from mechsearch_jax.runtime.files import is_file

    if not is_file(episode / NAME):
        raise InputError(f"{episode / NAME}: there is none; search once more with --record")
    return load_recording(episode / NAME)


def make_film(
    recording: Recording, path: Path, console: Console, width: int = WIDTH, fps: int = FPS, speed: float = 1.0
) -> None:
    """Write a film, with a progress bar.

    Raises:
      InputError: it cannot be written.
    """
    from rich.progress import track

    from mechsearch_jax.envs.recording.film import Film
    from mechsearch_jax.viz.movie import save_movie

    film = Film(recording, width, fps, speed)
    save_movie(track(film, "filming", total=film.count, console=console, transient=True), path, fps)
    console.print(str(path), soft_wrap=True, markup=False)


def make_page(recording: Recording, path: Path, console: Console, film: Path | None = None) -> None:
    """Write the page of an episode, which shows a film of it if there is one.

    Raises:
      InputError: it cannot be written.
    """
    from mechsearch_jax.envs.page.page import save_page

    with console.status("drawing"):
        save_page(recording, path, film)
    console.print(str(path), soft_wrap=True, markup=False)
