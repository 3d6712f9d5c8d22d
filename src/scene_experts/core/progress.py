"""Types of the callbacks that report progress."""

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called with the name of the task, the number of completed parts and the total number of parts (0:
unknown)."""
ByteProgress = Callable[[int, int], None]
"""Called with the number of bytes transferred and the total number of bytes (0: unknown)."""
