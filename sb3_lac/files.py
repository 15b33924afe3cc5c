"""Files that are never there in part."""

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """
    A place to write a file to, beside where it is to be. When the block ends the content goes to the disk, and then the file
    takes its name. If anything fails, all is as it was before.
    """
    # A link stays one, and what it leads to is replaced
    target = Path(os.path.realpath(path))
    target.parent.mkdir(parents=True, exist_ok=True)
    # A name that no process, thread or machine has but this; libraries go by the suffix
    part = target.with_name(f".{secrets.token_hex(8)}.part{target.suffix}")
    try:
        yield part
        with part.open("rb+") as stream:
            os.fsync(stream.fileno())
        if target.exists():  # what only its owner may read stays so
            shutil.copymode(target, part)
        os.replace(part, target)
        # Some systems cannot bring the name to the disk, and the file is whole all the same
        with suppress(OSError):
            folder = os.open(target.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
    finally:
        part.unlink(missing_ok=True)
