"""The callbacks through which long work reports its progress."""

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called with the name of the work, how much is done, and how much there is in total (0: unknown)."""
ByteProgress = Callable[[int, int], None]
"""Called with the number of bytes so far and in total (0: unknown)."""
