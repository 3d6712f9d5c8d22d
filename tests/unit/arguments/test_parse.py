"""From words to a dataclass; one sentence for words that do not fit."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest

from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, HelpAsked, parse
from scene_experts.core.errors import InputError
from support.messages import naming


@dataclass(frozen=True)
class Look:
    mode: Literal["picture", "depth"] = "picture"
    """What to draw."""
    gain: float = 1.0


@dataclass(frozen=True)
class Draw:
    """Draw a run."""

    run: Annotated[Path, Option(value="RUN")]
    """Run folder."""
    out: Annotated[Path, Option(short="-m", value="FILE")]
    look: Look = Look()
    iterations: int = 30_000
    lpips: bool = True
    resume: bool = False
    only: tuple[int, ...] = ()
    back: tuple[float, float, float] | None = None
    mirror: Annotated[tuple[str, ...], Option(repeat=True)] = ()


COMMAND = Command("se draw", ("run",), elsewhere=lambda flag: "`se train` has it" if flag == "--rates" else "")
NEEDED = ["r", "--out", "o"]


def read(*args: str) -> Draw:
    return parse(Draw, COMMAND, args)


def refuses(*args: str) -> str:
    with pytest.raises(InputError) as error:
        read(*args)
    text = str(error.value)
    assert text and "\n" not in text
    return text


def test_defaults_are_the_dataclass_own():
    assert read(*NEEDED) == Draw(Path("r"), Path("o"))


def test_every_form_of_an_option():
    args = ["--look.gain", "-2", "--iterations=7", "-m", "o", "--no-lpips", "--resume", "--only", "1", "2", "--back", "0", ".5", "1", "r"]
    assert read(*args, "--mirror", "a", "--mirror", "b") == Draw(
        Path("r"), Path("o"), Look(gain=-2.0), 7, False, True, (1, 2), (0.0, 0.5, 1.0), ("a", "b")
    )
    assert read("--mirror", "a", "r", "--out", "o").mirror == ("a",)  # takes one word, so that the run may follow
    assert read("--run", "r", "--out=o=p").out == Path("o=p") and read(*NEEDED, "--back", "none").back is None
    assert read("r", "--out", "-1").out == Path("-1")


@pytest.mark.parametrize(
    ("args", "facts"),
    [
        ([], ("expected RUN and --out, found neither", "se draw RUN --out FILE")),
        (["r"], ("expected --out, found none",)),
        ([*NEEDED, "--iteration", "5"], ("found --iteration", "did you mean '--iterations'?")),
        ([*NEEDED, "--iteration=5"], ("found --iteration;", "did you mean '--iterations'?")),
        ([*NEEDED, "--gain", "5"], ("found --gain", "did you mean '--look.gain'?")),
        ([*NEEDED, "--xyzzy"], ("found --xyzzy", "`se draw --help-all`")),
        ([*NEEDED, "-x"], ("found -x",)),
        ([*NEEDED, "--rates", "1"], ("`se train` has it",)),
        ([*NEEDED, "--iterations", "abc"], ("a whole number after --iterations", "'abc'", "--iterations 30000")),
        ([*NEEDED, "--iterations"], ("--iterations, found none", "--iterations 30000")),
        ([*NEEDED, "--iterations", "--resume"], ("--iterations, found none",)),
        ([*NEEDED, "--iterations", ""], ("after --iterations, found an empty one",)),
        ([*NEEDED, "--iterations="], ("after --iterations, found an empty one",)),
        (["", "--out", "o"], ("found an empty one",)),
        ([*NEEDED, "--look.mode", "deep"], ("picture or depth", "'deep'")),
        ([*NEEDED, "--out", "p"], ("--out once", "twice")),
        ([*NEEDED, "-m", "p"], ("--out once", "found --out and -m")),
        ([*NEEDED, "--lpips", "--no-lpips"], ("--lpips once", "found --lpips and --no-lpips")),
        ([*NEEDED, "--resume=yes"], ("--resume without a value", "--no-resume")),
        ([*NEEDED, "--only"], ("--only, found none",)),
        ([*NEEDED, "--back", "0", "1"], ("3 values after --back, found 2",)),
        ([*NEEDED, "other"], ("found also 'other'",)),
    ],
)
def test_one_sentence_for_each_mistake(args, facts):
    sentence = refuses(*args)
    assert all(fact in sentence for fact in facts), sentence


def test_files_that_a_shell_made_of_a_pattern_have_a_folder(tmp_path):
    @dataclass(frozen=True)
    class One:
        photos: Path

    files = [tmp_path / "a.jpg", tmp_path / "b.jpg"]
    for file in files:
        file.touch()
    with pytest.raises(InputError, match=naming(f"give the folder {tmp_path}")):
        parse(One, Command("prog", ("photos",)), [*map(str, files)])
    with pytest.raises(InputError, match="leave it out"):
        parse(One, Command("prog", ("photos",)), [str(files[0]), str(tmp_path)])


def test_words_of_a_list_may_stand_around_options():
    @dataclass(frozen=True)
    class Many:
        words: tuple[str, ...]
        fast: bool = False

    for args in (["a", "b", "--fast"], ["a", "--fast", "b"], ["--fast", "a", "b"]):
        assert parse(Many, Command("se", ("words",)), args) == Many(("a", "b"), True)


def test_underscores_are_hyphens():
    assert read(*NEEDED, "--no_lpips").lpips is False


def test_help_comes_before_everything_else():
    for args in (["--help"], ["-h"], ["--help-all"], ["--nonsense", "--help"]):
        with pytest.raises(HelpAsked, match="usage: se draw RUN --out FILE"):
            read(*args)
