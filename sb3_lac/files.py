"""Files that are never there in part."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A place to write a file to, beside where it is to be. It is renamed when the block ends, and removed if it fails."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    # Libraries go by the suffix
    part = target.with_name(f".{target.stem}.{os.getpid()}.part{target.suffix}")
    try:
        yield part
        os.replace(part, target)
    finally:
        part.unlink(missing_ok=True)
