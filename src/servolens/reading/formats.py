"""What a file is, by its content rather than by its name, and who reads it."""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

from servolens.errors import InputError
from servolens.reading import files
from servolens.reading.codesys import is_codesys, read_codesys
from servolens.reading.files import is_folder, read_bytes, read_start
from servolens.reading.isolated import read_isolated
from servolens.reading.json_text import read_json
from servolens.reading.lines import encoding_of
from servolens.reading.mat import read_mat
from servolens.reading.table import Table
from servolens.reading.text import read_text

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["SUFFIXES", "is_bag", "read_tables"]

SUFFIXES = (
    ".csv", ".tsv", ".mat", ".xlsx", ".xlsm", ".xls", ".ods", ".parquet", ".tdms", ".mf4", ".mdf", ".h5", ".hdf5",
    ".npz", ".npy", ".mcap", ".bag", ".db3", ".lvm", ".jsonl", ".csv.gz", ".trace",
)  # fmt: skip
"""Of the files that are read from a folder; names that reports and notes have too (.txt, .json) are not."""


@final
@dataclass(frozen=True, slots=True)
class _Kind:
    """A binary format: what it begins with, what people call it, and the module that reads it."""

    magic: bytes
    name: str
    module: str
    at: int = 0


BINARY_FORMATS = (
    _Kind(b"PAR1", "Parquet", "parquet"),
    _Kind(b"TDSm", "TDMS (LabVIEW)", "tdms"),
    _Kind(b"MDF     ", "MDF (ASAM measurement data)", "mdf"),
    _Kind(b"UnFinMF ", "MDF (ASAM measurement data)", "mdf"),
    _Kind(b"MATLAB 7.3", "MAT v7.3", "mat_objects"),
    _Kind(b"\x00\x02IM", "MAT v7.3", "mat_objects", 124),
    _Kind(b"\x89HDF\r\n\x1a\n", "HDF5", "hdf5"),
    _Kind(b"\x93NUMPY", "NumPy", "numpy_file"),
    _Kind(b"\x89MCAP0\r\n", "MCAP", "bags"),
    _Kind(b"#ROSBAG V2.0", "a ROS bag", "bags"),
    _Kind(b"SQLite format 3\x00", "SQLite (perhaps a ROS 2 bag)", "bags"),
    _Kind(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "an Excel 97 workbook", "workbook"),
)
NOT_READ = {
    **dict.fromkeys(
        (b"BZh%d1AY&SY" % level for level in range(1, 10)),
        "is compressed by bzip2; unpack it first, or pack it by gzip",
    ),
    b"\xfd7zXZ\x00": "is compressed by xz; unpack it first, or pack it by gzip",
    b"\x28\xb5\x2f\xfd": "is compressed by Zstandard; unpack it first, or pack it by gzip",
    b"7z\xbc\xaf\x27\x1c": "is a 7z archive; unpack it first",
    b"Rar!\x1a\x07": "is a RAR archive; unpack it first",
    b"ARROW1": "is an Arrow (Feather) file, which is not read; save it as Parquet",
    b"FEA1": "is a Feather file of version 1, which is not read; save it as Parquet",
    b"CDF\x01": "is a NetCDF file of version 3, which is not read; save it as version 4 or as CSV",
    b"CDF\x02": "is a NetCDF file of version 3, which is not read; save it as version 4 or as CSV",
    b"ULog\x01\x12\x35": "is a ULog of PX4, which is not read; convert it to CSV by ulog2csv",
    b"%PDF-": "is a PDF, which holds no signals; give the log itself",
    b"\x89PNG": "is a picture, which holds no signals; give the log itself",
    b"\xff\xd8\xff": "is a picture, which holds no signals; give the log itself",
}
"""What files begin with that are known and not read, and what to do; each is the format's own mark."""
_PICKLE = re.compile(rb"\x80[\x02-\x05]")
_MAT5 = (b"\x00\x01IM", b"\x01\x00MI")
_GZIP, _ZIP = b"\x1f\x8b", b"PK\x03\x04"
_LOOKED_AT = 4096


def read_tables(path: Path) -> tuple[Table, ...]:
    """Return the tables of a file, or of the folder of a ROS 2 bag.

    Raises
    ------
    InputError
        If the path is no regular file, if its format is not known or needs a library that is not installed, or if
        the file is damaged.
    """
    if is_bag(path):
        return read_isolated("bags", path, "a ROS 2 bag")
    start = read_start(path, _LOOKED_AT)
    kind = _kind(start)
    if kind is not None:
        return read_isolated(kind.module, path, kind.name)
    content = read_bytes(path)
    if start.startswith(_GZIP):
        content = _unpacked(content)
        if _kind(content[:_LOOKED_AT]) is not None or content.startswith(_GZIP):
            raise InputError("is a packed file of another kind than text; unpack it first")
    return _plain(content, path)


def is_bag(path: Path) -> bool:
    """Tell whether a folder is a ROS 2 bag."""
    return is_folder(path) and (path / "metadata.yaml").is_file()


def _kind(start: bytes) -> _Kind | None:
    for kind in BINARY_FORMATS:
        if start[kind.at :].startswith(kind.magic):
            return kind
    if start.startswith(_ZIP):
        is_numpy = b".npy" in start[:256]
        return _Kind(_ZIP, "NumPy", "numpy_file") if is_numpy else _Kind(_ZIP, "an Excel workbook", "workbook")
    return None


def _plain(content: bytes, path: Path) -> tuple[Table, ...]:
    """Read MAT v5, a trace of CODESYS, JSON or text."""
    if content[124:128] in _MAT5:
        table = read_mat(content)
        if sum(column.values.size > 1 for column in table.columns) > 1 or not table.columns:
            return (table,)
        if all(column.fault is None for column in table.columns):
            return (table,)
        deep = read_isolated("mat_objects", path, "MAT with structures or tables")
        found = {column.name.partition(".")[0] for inner in deep for column in inner.columns}
        left = tuple(column for column in table.columns if column.fault and column.name not in found)
        return (*deep, Table(left)) if left else deep
    if path.suffix.lower() == ".mat":
        raise InputError("is not a MAT v5 or v7.3 file (version 4, or damaged); save it with -v7 in MATLAB")
    _check_known(content)
    if b"\0" in content[: 2 * _LOOKED_AT] and encoding_of(content) is None:
        raise InputError("is a binary file of an unknown kind; see the documentation for the formats that are read")
    if is_codesys(content):
        return read_codesys(content)
    if content.lstrip()[:1] in (b"{", b"["):
        return read_json(content)
    return read_text(content)


def _check_known(content: bytes) -> None:
    """Refuse a file of a kind that is known and not read, by its name."""
    told = next((said for magic, said in NOT_READ.items() if content.startswith(magic)), None)
    if told is None and _PICKLE.match(content) and content.rstrip(b"\n").endswith(b"."):
        told = "is a pickle, which may run code and is not read; save it as CSV or Parquet"
    if told is not None:
        raise InputError(told)


def _unpacked(content: bytes) -> bytes:
    """Return what a gzip file holds, at most as much as of any file."""
    parts: list[bytes] = []
    size = 0
    while content:
        packer = zlib.decompressobj(wbits=31)
        try:
            parts.append(packer.decompress(content, files.MAX_BYTES - size + 1))
        except zlib.error as error:
            raise InputError("is a damaged gzip file; pack it again") from error
        size += len(parts[-1])
        if size > files.MAX_BYTES:
            raise InputError(f"unpacks to more than {files.MAX_BYTES / 2**20:.0f} MiB, the most that is read")
        if not packer.eof:
            raise InputError("is a gzip file that ends early; copy it again")
        content = packer.unused_data
    if not size:
        raise InputError("is empty; check how it was written")
    return b"".join(parts)
