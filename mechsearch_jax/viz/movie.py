"""Write movies: MP4 (H.264, for all browsers and players) and animated WebP (for pages)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import UInt8

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, replacing

Images = Iterable[UInt8[np.ndarray, "h w 3"]]
# Quality of H.264, better if smaller, and of WebP, better if larger.
CRF, QUALITY = "20", 70


def check_movie_path(path: PathLike) -> None:
    """Check before the work begins that `save_movie` supports a file's ending.

    Raises:
      InputError: it does not.
    """
    if Path(path).suffix.lower() not in WRITERS:
        raise InputError(f"{path}: ends in none of {', '.join(WRITERS)}; name a file that does")


def save_movie(images: Images, path: PathLike, fps: int) -> None:
    """Write images as a movie.

    Args:
      images: at least one, all of the same even width and height; consumed one by one.
      path: of the file, which ends in .mp4 or .webp.
      fps: images per second.

    Raises:
      InputError: the ending is unknown, or the file cannot be written.
    """
    check_movie_path(path)
    with replacing(path) as file:
        WRITERS[Path(path).suffix.lower()](images, file, fps)


def _write_mp4(images: Images, file: IO[bytes], fps: int) -> None:
    import av

    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps), options={"crf": CRF, "preset": "veryfast"})
        stream.pix_fmt = "yuv420p"
        for i, image in enumerate(images):
            if i == 0:
                stream.height, stream.width = image.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")))
        container.mux(stream.encode())


def _write_webp(images: Images, file: IO[bytes], fps: int) -> None:
    from PIL import Image

    pictures = (Image.fromarray(image) for image in images)
    first = next(pictures)
    # No key frames within 60 s: only changes are written.
    first.save(
        file, format="WEBP", save_all=True, append_images=pictures, duration=round(1000 / fps), loop=0,
        quality=QUALITY, method=4, kmin=1000, kmax=2000,
    )  # fmt: skip


WRITERS: Mapping[str, Callable[[Images, IO[bytes], int], None]] = {".mp4": _write_mp4, ".webp": _write_webp}
