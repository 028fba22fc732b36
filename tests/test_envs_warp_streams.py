"""Warp does not forget the streams of others when one of several wrappers of them ends."""

import gc
from types import SimpleNamespace

import pytest

from mechsearch_jax.envs.simulators.mjx_model import import_mjx
from mechsearch_jax.envs.simulators.warp_streams import keep_streams


class Wrapper:
    """As `warp.Stream`: its end has Warp forget the stream, whoever else wraps it."""

    def __init__(self, known, handle, owner=False):
        self.known, self.handle, self.owner = known, handle, owner
        known.add(handle)

    def __del__(self):
        self.known.discard(self.handle)


def test_a_wrapper_in_a_cycle_does_not_end_the_stream_of_a_later_one():
    class Kept(Wrapper):
        pass

    class Own(Wrapper):
        pass

    for wrapper, survives in ((Wrapper, False), (Kept, True)):
        if survives:
            wrapper.__del__ = Wrapper.__del__
            keep_streams(wrapper)
            keep_streams(wrapper)
        known = set()
        frame = {"stream": wrapper(known, 7)}
        frame["frame"] = frame
        later = wrapper(known, 7)
        del frame
        gc.collect()
        assert (7 in known) == survives
        del later
    Own.__del__ = Wrapper.__del__
    keep_streams(Own)
    known = set()
    own = Own(known, 8, owner=True)
    assert known == {8}
    del own
    assert not known


def test_warps_own_class_has_what_is_changed(monkeypatch):
    warp = pytest.importorskip("warp")
    import_mjx()
    from warp._src import context

    ended = []
    core = SimpleNamespace(
        wp_cuda_stream_destroy=lambda _, handle: ended.append(("destroyed", handle)),
        wp_cuda_stream_unregister=lambda _, handle: ended.append(("forgotten", handle)),
    )
    monkeypatch.setattr(context, "runtime", SimpleNamespace(core=core))
    for handle, owner in ((7, False), (8, True)):
        stream = warp.Stream.__new__(warp.Stream)
        stream.cuda_stream, stream.owner, stream.device = handle, owner, SimpleNamespace(context=None)
        del stream
    assert ended == [("destroyed", 8)]
