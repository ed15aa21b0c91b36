"""NumPy's .npy and .npz files; objects, which would have to be unpickled, are refused."""

from __future__ import annotations

import zipfile
import zlib
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError
from servolens.reading import files
from servolens.reading.nested import tables_of

if TYPE_CHECKING:
    from pathlib import Path

    from servolens.reading.table import Table

__all__ = ["read"]


def read(path: Path) -> list[Table]:
    """Return the arrays of a NumPy file.

    Raises
    ------
    InputError
        If the file is damaged, too large, or holds objects.
    """
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                if sum(item.file_size for item in archive.infolist()) > files.MAX_BYTES:
                    raise InputError(f"unpacks to more than {files.MAX_BYTES / 2**20:.0f} MiB, the most that is read")
            with np.load(path, allow_pickle=False) as archive:
                tree = {name: _array(archive, name) for name in archive.files}
        else:
            tree = {"array": np.load(path, allow_pickle=False, mmap_mode=None)}
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        if isinstance(error, InputError):
            raise
        what = "holds objects, which are not read" if "pickle" in str(error) else "is a damaged NumPy file"
        raise InputError(f"{what}; save plain arrays with numpy.savez") from error
    tables = list(tables_of({name: value for name, value in tree.items() if value is not None}))
    if not tables:
        raise InputError("holds no arrays of numbers; save plain arrays with numpy.savez")
    return tables


def _array(archive: np.lib.npyio.NpzFile, name: str) -> np.ndarray | None:
    array = archive[name]
    return array if array.dtype.kind in "biufmMVU" else None
