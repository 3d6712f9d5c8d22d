"""How much one file of each format may cost: its size, what it unpacks to, its items, its nesting
and its time.

A limit is far above what an honest file needs: a PLY file of 10 million Gaussians has 2.5 GB, a
compact file of 2 million anchors 0.3 GB, and a capture of 5,000 views has a transforms.json of 4
MB. What a file unpacks to is limited relative to its size, so a small file can never take much
memory, and a large honest file is never refused. Values are decoded to four times their stored size
at most, and honest columns compress by two to four: hence the ratio of 16. Harmonics of degree 3
compress by more in packed files: a Gaussian may have 16 bytes in SPZ or 13 in SOG, and 472 in
memory. So their ratios are 32 and 40.
"""

from __future__ import annotations

from dataclasses import dataclass

MIB, GIB = 1 << 20, 1 << 30
BYTES_PER_SECOND = 2 * MIB
"""Least speed of a reader. A file may take its budget's seconds and its size divided by this."""


class Damaged(ValueError):
    """The content of a file does not fit its format. The message completes "expected a whole FILE
    at PATH, found ..."."""


class CutShort(Damaged):
    """Bytes of a file are missing: another copy of it may be whole."""


CONVERT = "convert it to PLY (SuperSplat and splat-transform do that) or write it again"


@dataclass(frozen=True)
class Budget:
    """Limits of one format.

    Attributes:
        what: What a file of the format is called in error messages.
        bytes_in: Largest file in bytes.
        floor: Bytes in memory that a file of any size may unpack to.
        ratio: Bytes in memory per byte of the file, in addition to `floor`.
        items: Largest number of entries: members of an archive, values of a JSON file, operations
            of a pickle, lines of a header.
        depth: Largest nesting of lists and objects.
        seconds: Processor time that a small file may take; see BYTES_PER_SECOND. Readers check it
            between their steps.
        advice: What the user can do about a damaged file.
        other: What the user can do about a file whose bytes are all there, but whose content this
            version does not read; empty: `advice`.
    """

    what: str
    bytes_in: int
    floor: int = 256 * MIB
    ratio: int = 16
    items: int = 4_000_000
    depth: int = 32
    seconds: float = 4.0
    advice: str = "copy it again or write it again"
    other: str = ""

    def allowance(self, size: int) -> int:
        """Return how many bytes a file of `size` bytes may take in memory."""
        return self.floor + self.ratio * size

    def time_limit(self, size: int) -> float:
        """Return how many seconds a file of `size` bytes may take."""
        return self.seconds + size / BYTES_PER_SECOND


# --- descriptions -------------------------------------------------------------------------------------------------------------------------

JSON = Budget("JSON file", 32 * MIB, advice="restore or remove the file")
META = Budget("description", 16 * MIB)  # JSON inside another file
LINES = Budget("file of metrics", 1 * GIB, items=20_000_000)  # one JSON object per line
LINE = Budget("line of metrics", 1 * MIB, items=100_000)
SETTINGS = Budget("cfg_args file", 1 * MIB, items=1_000, depth=4, advice="remove the file to go on without it")
NOTE = Budget("note", 1 * MIB)

# --- captures -----------------------------------------------------------------------------------------------------------------------------

CAPTURE = Budget("capture", 1 << 60, advice="restore its files")
COLMAP = Budget("COLMAP file", 32 * GIB, advice="copy it again", other="export the reconstruction again")
LIST = Budget("list of photographs", 64 * MIB)
POSES = Budget("file of poses", 1 * GIB, items=20_000_000, advice="export it again")
POINTS = Budget("PLY file of points", 16 * GIB, items=4_096, advice="copy it again", other="export the points again")
PHOTOGRAPH = Budget("image", 2 * GIB, floor=192 * MIB, ratio=40, advice="replace it, or leave it out with --leave-out")
CAPTURED = Budget("photograph or mask", 2 * GIB, floor=512 * MIB, ratio=40, advice="replace or remove it")  # before a reconstruction
MASK = Budget("mask", 1 * GIB, floor=512 * MIB, ratio=40, advice="replace or remove it")
DEPTH = Budget("depth map", 1 * GIB, floor=512 * MIB, ratio=40, advice="export it again")
PICTURE = Budget("picture", 1 * GIB, floor=160 * MIB, ratio=40, advice="evaluate the run again")

# --- scenes -------------------------------------------------------------------------------------------------------------------------------

HEAD = Budget("file", 1 << 50, other=CONVERT)  # the first bytes, by which formats are recognised
PLY = Budget("PLY file", 256 * GIB, items=4_096, other="write it again with the columns of 3DGS (SuperSplat and splat-transform do that)")
COMPRESSED_PLY = Budget("compressed PLY file", 64 * GIB, items=4_096, other=CONVERT)
SPLAT = Budget(".splat file", 64 * GIB, other=CONVERT)
KSPLAT = Budget(".ksplat file", 64 * GIB, items=4_096, other=CONVERT)
SPZ = Budget("SPZ file", 16 * GIB, ratio=32, other=CONVERT)
SOG = Budget("SOG file", 16 * GIB, ratio=40, items=256, other=CONVERT)
GLB = Budget("glTF file", 64 * GIB, floor=64 * MIB, ratio=10, items=20_000, other=CONVERT)
USD = Budget("OpenUSD file", 64 * GIB, other=CONVERT)
HTML = Budget("html page", 16 * GIB, ratio=32, other=CONVERT)
ZIP = Budget("zip file", 64 * GIB, floor=32 * MIB, ratio=4, items=20_000, other="unpack it and give the file or folder of the scene")
COMPACT = Budget("compact scene", 64 * GIB, ratio=64, seconds=60.0, other="export it again")  # seconds: without the compiled library
RUN = Budget("run folder", 1 << 60, advice="restore its files or train again")
CHECKPOINT = Budget("checkpoint", 1 << 40, items=100_000, advice="use an older one or copy it again")
NETWORK = Budget("network file", 16 * GIB, floor=128 * MIB, ratio=4, items=200_000, depth=50, advice="get it again")
WEIGHTS = Budget("file of LPIPS weights", 4 * GIB, ratio=4, items=1_000, advice="remove the file and get it again")
FEATURES = Budget(
    "file of features", 64 * MIB, ratio=4, items=100, advice="remove the folder .capture of the capture and repeat the command"
)
