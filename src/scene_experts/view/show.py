"""What a picture can show."""

from typing import Literal, get_args

Show = Literal["picture", "depth", "alpha", "experts", "entropy", "activation"]
SHOWS: tuple[Show, ...] = get_args(Show)
