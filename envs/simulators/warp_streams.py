"""Keeps Warp from forgetting the stream that it records for JAX.

A call of Warp from JAX wraps JAX's stream in a `warp.Stream`, and the end of any such wrapper has Warp forget the
stream. Calls that build kernels leave their frames, and with them their wrappers, in reference cycles. Python's garbage
collector ends these wrappers at any later time, also while a later call records the same stream. That recording then
fails with "unknown stream" or "unknown capture stream", and an allocation in it with CUDA error 900; after the latter
all of JAX's computations fail, too.
"""

from __future__ import annotations

import functools
from typing import Any


def keep_streams(stream: Any) -> None:
    """Have Warp know the streams of others for as long as the process lives; they are few.

    Args:
      stream: the class `warp.Stream`; changed once, however often this is called.
    """
    end = stream.__del__
    if hasattr(end, "__wrapped__"):
        return

    @functools.wraps(end)
    def end_if_owned(self: Any) -> None:
        if self.owner:
            end(self)

    stream.__del__ = end_if_owned
