"""Moving pictures as files: MP4 (H.264, which every browser and player shows) and animated WebP (for pages)."""

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
# Of H.264, the smaller the better; and of WebP, the larger the better.
CRF, QUALITY = "20", 70


def check_movie_path(path: PathLike) -> None:
    """Fail before the work begins, where a file's ending is none that `save_movie` knows.

    Raises:
      InputError: it is not.
    """
    if Path(path).suffix.lower() not in WRITERS:
        raise InputError(f"{path}: ends in none of {', '.join(WRITERS)}; name a file that does")


def save_movie(images: Images, path: PathLike, fps: int) -> None:
    """Write images, one after the other, as a moving picture.

    Args:
      images: all of the same even width and height, at least one; they are taken one by one.
      path: of the file; its ending says what is written, .mp4 or .webp.
      fps: images in a second.

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
    # Within 60 s nothing is worth a whole new picture: only what changes is written.
    first.save(
        file, format="WEBP", save_all=True, append_images=pictures, duration=round(1000 / fps), loop=0,
        quality=QUALITY, method=4, kmin=1000, kmax=2000,
    )  # fmt: skip


WRITERS: Mapping[str, Callable[[Images, IO[bytes], int], None]] = {".mp4": _write_mp4, ".webp": _write_webp}
