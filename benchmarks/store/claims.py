"""Which process at a folder runs which episode, so that those that work side by side do not do the same work.

A process takes an episode by making a file of its name, which can be done only once. The file names its owner, and is
removed when the episode's row is there. Each owner keeps a file of its own locked and touches it every now and then.
What an owner took is free again when it is gone: on this machine that is when nothing holds the lock, at once after a
kill; elsewhere, and after this machine was started anew, when its file has not been touched for `SILENCE` seconds by
this process's clock, since clocks differ, or is older than they ever differ (`OLD`).

Claims only save work. A machine that slept and wakes up may run an episode that another took from it; `shards` says
which row counts then.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import threading
import time
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path

from mechsearch_jax.benchmarks.store.shards import OPEN, close_shards_of, writers_of_open_shards
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.files import PathLike, check_writable

CLAIMS = "claims"
OWNER_ENDING = ".owner"
# How often an owner shows that it is there, and how long it may be silent [s].
TOUCHED_EVERY, SILENCE = 10.0, 120.0
# Age of such a sign that no difference between clocks explains [s].
OLD = 3600.0


def _machine() -> str:
    """What tells this machine, since it was started, from all others: locks are only trusted within it."""
    try:
        started = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        started = ""
    return f"{socket.gethostname()} {started}"


def new_owner() -> str:
    """A name that no other process has: the time, so that names sort by it, the machine and something random."""
    host = "".join(c if c.isalnum() else "-" for c in socket.gethostname())[:30]
    return f"{time.strftime('%Y%m%dT%H%M%S', time.gmtime())}-{host}-{uuid.uuid4().hex[:8]}"


class Claims:
    """The claims of this process; a context, at the end of which it gives all of them up.

    Attributes:
      owner: the name that it goes by.
      mine: the episodes that it has taken.
    """

    def __init__(self, folder: PathLike, touched_every: float = TOUCHED_EVERY, silence: float = SILENCE) -> None:
        """Args:
          folder: of the results.
          touched_every: seconds between the signs that it is there.
          silence: of seconds, after which another owner is gone.

        Raises:
          InputError: the folder cannot be written to.
        """
        self.owner = new_owner()
        self._folder = Path(folder)
        self._open, self._claims = self._folder / OPEN, self._folder / OPEN / CLAIMS
        self._touched_every, self._silence = touched_every, silence
        self.mine: set[str] = set()
        # When each owner's file was touched last, and when that was first seen here.
        self._seen: dict[str, tuple[int, float]] = {}
        self._over = threading.Event()
        check_writable(self._claims)
        self._lock = self._show()
        self._toucher = threading.Thread(target=self._touch, daemon=True)

    def __enter__(self) -> Claims:
        self._toucher.start()
        return self

    def __exit__(self, *details: object) -> None:
        self._over.set()
        self._toucher.join()
        for episode in list(self.mine):
            self.release(episode)
        self._owner_file(self.owner).unlink(missing_ok=True)
        os.close(self._lock)

    def take(self, episode: str) -> bool:
        """Whether an episode is this process's to run: True once it was free, or its owner is gone.

        Raises:
          InputError: the folder cannot be written to.
        """
        path = self._claims / episode
        while self.is_free(episode):
            try:
                with open(path, "x") as file:
                    file.write(self.owner)
            except FileExistsError:
                continue
            except OSError as error:
                raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error
            self.mine.add(episode)
            return True
        return False

    def free(self, episodes: Iterable[str]) -> set[str]:
        """Those of many episodes that nobody runs.

        Raises:
          InputError: the folder cannot be read.
        """
        try:
            taken = set(os.listdir(self._claims))
        except OSError as error:
            raise InputError(f"{self._claims}: cannot be read ({error.strerror or error})") from error
        return {episode for episode in episodes if episode not in taken or self.is_free(episode)}

    def is_free(self, episode: str) -> bool:
        """Whether nobody runs an episode; a claim of one that is gone is removed."""
        path = self._claims / episode
        try:
            owner, made = path.read_text(), path.stat().st_mtime_ns
        except FileNotFoundError:
            return True
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
        # One that was killed before it wrote its name shows by the claim itself that it is gone.
        if not (self._is_gone(owner) if owner else self._is_silent(episode, made)):
            return False
        path.unlink(missing_ok=True)
        return True

    def release(self, episode: str) -> None:
        """Give an episode up, because its row is there or because it is not to be run."""
        self.mine.discard(episode)
        path = self._claims / episode
        with contextlib.suppress(OSError):
            # Whoever thought that this process was gone may have it.
            if path.read_text() == self.owner:
                path.unlink()

    def close_what_is_left(self) -> None:
        """Close the shards of processes that are gone, and remove their claims.

        Gone are those that were killed on this machine, that were silent for long, and that ended without closing their
        shards, as on a full disk.

        Raises:
          InputError: a shard cannot be read or written.
        """
        # An owner's file is there before its first shard: a shard that is seen first and has no owner is left over.
        writers = writers_of_open_shards(self._folder)
        owners = {path.name.removesuffix(OWNER_ENDING) for path in self._open.glob(f"*{OWNER_ENDING}")}
        for owner in sorted(writers | owners):
            if self._is_gone(owner):
                close_shards_of(self._folder, owner)
                self._owner_file(owner).unlink(missing_ok=True)
        for claim in self._claims.iterdir():
            self.is_free(claim.name)

    def _owner_file(self, owner: str) -> Path:
        return self._open / f"{owner}{OWNER_ENDING}"

    def _show(self) -> int:
        """Make this owner's file, which is locked from the moment that it is there; its descriptor."""
        hidden = self._open / f".{self.owner}"
        try:
            lock = os.open(hidden, os.O_CREAT | os.O_EXCL | os.O_RDWR)
            os.write(lock, _machine().encode())
            # Where nothing can be locked, others go by when it was touched.
            with contextlib.suppress(OSError):
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.replace(hidden, self._owner_file(self.owner))
        except OSError as error:
            raise InputError(f"{self._open}: cannot be written to ({error.strerror or error})") from error
        return lock

    def _touch(self) -> None:
        while not self._over.wait(self._touched_every):
            with contextlib.suppress(OSError):
                os.utime(self._owner_file(self.owner))

    @contextlib.contextmanager
    def _locked(self, owner: str) -> Iterator[bool]:
        """Hold an owner's lock; False where it is of another machine, still held, or cannot be told."""
        try:
            lock = os.open(self._owner_file(owner), os.O_RDWR)
        except OSError:
            yield False
            return
        try:
            held = os.read(lock, 1000) == _machine().encode()
            if held:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except OSError:
                    held = False
            yield held
        finally:
            os.close(lock)

    def _is_gone(self, owner: str) -> bool:
        if owner == self.owner:
            return False
        try:
            touched = self._owner_file(owner).stat().st_mtime_ns
        except FileNotFoundError:
            return True
        with self._locked(owner) as locked:
            return locked or self._is_silent(owner, touched)

    def _is_silent(self, name: str, touched: int) -> bool:
        """Whether something has not been touched for long, as far as this process has seen or the file says."""
        if time.time() - touched / 1e9 > OLD:
            return True
        now = time.monotonic()
        before, since = self._seen.setdefault(name, (touched, now))
        if before != touched:
            self._seen[name] = touched, now
            return False
        return now - since > self._silence
