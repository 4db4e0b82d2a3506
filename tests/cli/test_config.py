"""Files of options: values as of the command line, and one sentence for whatever is wrong with them."""

import re
import tempfile
import textwrap
from argparse import Namespace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pancam_graph.base.errors import InputError
from pancam_graph.cli import main
from pancam_graph.cli._main import parse
from pancam_graph.cli._registry import COMMANDS


def parsed(tmp_path: Path, text: str, *words: str, command: str = "refine") -> Namespace:
    file = tmp_path / "options.toml"
    file.write_text(text, encoding="utf-8")
    return parse(COMMANDS[command], [*words, "--config", str(file)], f"pancam-graph {command}")


def test_values_are_those_of_the_command_line(tmp_path: Path) -> None:
    text = """
        quiet = true
        [refine]
        out = "out"
        model = "circle"
        stop = ["max_iterations=3", "relative_step=1e-3"]
        sharing = ["calibration=eye:focal", "radius=eye"]
        export = ["colmap", "cahvor"]
        mosaic = true
        no-report = true
        [simulate]
        nothing = "is looked at here"
    """
    words = ["F", "--out", "out", "--quiet", "--model", "circle", "--stop", "max_iterations=3"]
    words += ["--stop", "relative_step=1e-3", "--sharing", "calibration=eye:focal", "radius=eye"]
    words += ["--export", "colmap", "cahvor", "--mosaic", "--no-report"]
    from_file, typed = vars(parsed(tmp_path, text, "F")), vars(parse(COMMANDS["refine"], words, "x"))
    assert from_file.pop("config") == tmp_path / "options.toml"
    assert typed.pop("config") is None
    lists = ("stop", "sharing", "export")
    assert {k: list(from_file.pop(k)) for k in lists} == {k: list(typed.pop(k)) for k in lists}
    assert from_file == typed


def test_numbers_are_those_of_the_command_line_to_the_last_bit(tmp_path: Path) -> None:
    text = '[render]\nout = "o"\nsweep-deg = 123.4\ntilts-deg = [-10, 7.7]\nstep-m = 3\nseed = 5\nbits = 12'
    words = [
        "--out",
        "o",
        "--sweep-deg",
        "123.4",
        "--tilts-deg",
        "-10",
        "7.7",
        "--step-m",
        "3",
        "--seed",
        "5",
        "--bits",
        "12",
    ]
    from_file = parsed(tmp_path, text, command="render")
    typed = parse(COMMANDS["render"], words, "x")
    for name in ("sweep_rad", "spacing_m", "seed", "bits"):
        assert getattr(from_file, name) == getattr(typed, name)
    assert list(from_file.tilts_rad) == list(typed.tilts_rad)


def test_a_byte_order_mark_is_no_content(tmp_path: Path) -> None:
    """Some editors of Windows write one before UTF-8."""
    file = tmp_path / "options.toml"
    file.write_bytes(b"\xef\xbb\xbf[refine]\r\nmodel = 'free'\r\n")
    words = ["F", "--out", "o", "--config", str(file)]
    assert parse(COMMANDS["refine"], words, "pancam-graph refine").model == "free"


def test_the_command_line_wins(tmp_path: Path) -> None:
    text = (
        '[refine]\nout = "file"\nmodel = "free"\nexport = "colmap"\nstop = "max_iterations=3"\nmosaic = true'
    )
    words = ("F", "--out", "line", "--model", "mast", "--export", "cahvor", "--no-mosaic", "--stop", "a=1")
    arguments = parsed(tmp_path, text, *words)
    assert (arguments.out, arguments.model) == (Path("line"), "mast")
    assert (arguments.export, arguments.stop, arguments.mosaic) == (["cahvor"], ["a=1"], False)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[refine]\nmodle = 'mast'", "[refine] modle: expected the long name of an option of refine, found an unknown key; is 'model' meant?"),  # noqa: E501  the whole sentence
        ("[refine]\nstop = 3", "[refine] stop: expected text, found 3"),
        ("[refine]\nmosaic = 'yes'", "[refine] mosaic: expected true or false, found 'yes'"),
        ("[refine]\nmodel = 'ring'", "[refine] model: expected one of mast, circle, free, projective"),
        ("[refine]\nexport = 'colmop'", "[refine] export: expected one of colmap, cahvor, rig, gis; found 'colmop'; is 'colmap' meant?"),  # noqa: E501  the whole sentence
        ("[refine]\nexport = []", "[refine] export: expected one entry or more, found an empty list"),
        ("[refine]\nout = ['a', 'b']", "[refine] out: expected text, found a list of 2"),
        ("[refine]\nreport = true\nno-report = true", "no-report: expected report or no-report, found both"),
        ("[refine]\nconfig = 'more.toml'", "[refine] config: expected the long name of an option of refine"),
        ("[refin]\nmodel = 'mast'", "refin: expected a table of a subcommand"),
        ("[refin]\nmodel = 'mast'", "found another key; is 'refine' meant?"),
        ("model = 'mast'", "found another key; model belongs into [refine]"),
        ("refine = 3", "refine: expected a table [refine], found 3"),
        ("quiet = 1", "quiet: expected true or false, found 1"),
        ("[refine", "expected a file of options in TOML, found an error: "),
        ('[refine]\nout = "a\\u0000b"', "[refine] out: expected text without a NUL character"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_sentence(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(InputError) as raised:
        parsed(tmp_path, text, "F", "--out", "out")
    sentence = str(raised.value)
    assert sentence.startswith(f"{tmp_path / 'options.toml'}: ")
    assert says in sentence
    assert "\n" not in sentence


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[simulate]\nseed = 1.0", "[simulate] seed: expected a whole number, found 1.0"),
        ("[simulate]\nseed = true", "[simulate] seed: expected a whole number, found true"),
        ("[simulate]\nsweep-deg = '90'", "[simulate] sweep-deg: expected a number of degrees, found '90'"),
        ("[simulate]\nseed = 0x" + "f" * 5000, "[simulate] seed: expected a whole number, found one too long"),  # noqa: E501  the whole sentence
    ],
)  # fmt: skip
def test_wrong_numbers_are_one_sentence(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(InputError) as raised:
        parsed(tmp_path, text, "OUT", command="simulate")
    assert str(raised.value) == f"{tmp_path / 'options.toml'}: {says}"


def test_the_example_of_the_documentation_is_a_file_of_options(tmp_path: Path) -> None:
    page = Path(__file__).resolve().parents[2] / "docs" / "files.md"
    if not page.exists():
        pytest.skip("no docs/files.md: it is part of the repository, not of the installed package")
    (example,) = re.findall(
        r"^    progress = .*?(?=\n\n\S)", page.read_text("utf-8"), re.DOTALL | re.MULTILINE
    )
    arguments = parsed(tmp_path, textwrap.dedent(example), "F")
    assert (arguments.progress, arguments.mosaic) == ("json", True)
    assert arguments.export == ("colmap", "cahvor")


def test_no_file_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["refine", "F", "--out", "out", "--config", str(tmp_path / "none.toml")]) == 2
    assert capsys.readouterr().err == (
        f"{tmp_path / 'none.toml'}: expected a file of options, found none to read "
        "(No such file or directory)\n"
    )


NAMES = ["verbose", "quiet", "log", "progress", *COMMANDS, "out", "model", "stop", "sharing", "export"]
NAMES += ["mosaic", "no-mosaic", "seed", "tilts-deg", "bits", "rig"]
KEYS = st.sampled_from(NAMES) | st.text(max_size=8)
SCALARS = (
    st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=12)
    | st.sampled_from(["mast", "colmap", "json", "mer-navcam", "x"])
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3),
    max_leaves=8,
)


def as_toml(value: object) -> str:
    """A value of TOML, tables inline."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{as_toml(str(k))} = {as_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(as_toml(v) for v in value) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + "".join(f"\\U{ord(c):08X}" for c in value) + '"'
    return repr(value)


@settings(deadline=None, max_examples=30)  # the first that names an export or a rig loads its room
@given(
    content=st.dictionaries(KEYS, VALUES, max_size=4)
    | st.builds(
        lambda name, table: {name: table},
        st.sampled_from(sorted(COMMANDS)),
        st.dictionaries(KEYS, VALUES, max_size=5),
    ),
    command=st.sampled_from(sorted(COMMANDS)),
)
def test_any_tables_are_options_or_one_sentence(content: dict[str, object], command: str) -> None:
    check_any("\n".join(f"{as_toml(k)} = {as_toml(v)}" for k, v in content.items()).encode(), command)


@settings(deadline=None)
@given(content=st.binary(max_size=60) | st.text(max_size=60).map(lambda t: t.encode("utf-8", "replace")))
def test_any_bytes_are_options_or_one_sentence(content: bytes) -> None:
    check_any(content, "refine")


def check_any(content: bytes, command: str) -> None:
    words = {"refine": ["F", "--out", "o"], "render": ["--out", "o"], "completion": ["bash"]}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "options.toml"
        file.write_bytes(content)
        given_words = [*words.get(command, ["OUT"]), "--config", str(file)]
        try:
            arguments = parse(COMMANDS[command], given_words, "pancam-graph")
        except InputError as error:
            assert str(error).startswith(f"{file}: ")
            assert "\n" not in str(error)
            assert "expected" in str(error)
        except SystemExit as end:  # --verbose and --quiet together
            assert end.code == 2
        else:
            plain = parse(COMMANDS[command], given_words[:-2], "pancam-graph")
            assert set(vars(arguments)) == set(vars(plain))


def test_nesting_without_end_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a file of options in TOML"):
        parsed(tmp_path, "a = " + "[" * 100_000, "F", "--out", "out")
