"""The command line: errors of one line, options named as the user typed them, whole words."""

import re
from typing import Any

import pytest

from rbl_gym.app import cli
from tests.helpers import ROOT

LOG = ROOT / "examples" / "log"
FILES = [f"--{name}={LOG / name}.csv" for name in ("ranges", "anchors", "tags")]


def said(capsys, *arguments):
    """Run a command that must fail with status 2; return what it prints on standard error."""
    try:
        status = cli.main(arguments)
    except SystemExit as stop:
        status = stop.code
    assert status == 2
    return capsys.readouterr().err.rstrip("\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["replay", *FILES, "--rangestd", "1"], r"unknown argument '--rangestd'.*'--range-std-m'"),
        (["replay", "--anchors", "a.csv"], "required: --ranges"),
        (["replay", *FILES, "--start", "1,2"], "--start: must be x,y,z or x,y,z,yaw_deg"),
        (["replay", *FILES, "--filter", "ikef"], "--filter must be one of .* did you mean 'iekf'"),
        (["replay", *FILES, "--range-std-m", "-1"], "--range-std-m must be .* got -1"),
        (["replay", *FILES, "--height-m", "1"], "--height-m needs --height-std-m, its"),
        (["replay", *FILES, "--plot", "x.foo"], "--plot: must end in one of .png, .*'x.foo'"),
        (["place", "--scene", "uwb_rom"], "--scene must be one of .* did you mean 'uwb_room'"),
        (
            ["replay", *FILES, "--columns", "foo=bar"],
            "missing column 'bar' .*'foo' is not a known qu",
        ),
        (["replay", *FILES, "--height-m", "1"], ".*; or set --planar, with which the height is"),
        (["bench", "--filters", "iekf,ikef"], "--filters: filter must be one of .* mean 'iekf'"),
        (["bench", "--filters", "iekf", "my:Ekf"], "'my:Ekf'; separate the values of --filters by"),
        (["bench", "--filters", "my.sub.Ekf"], "--filters: filter must be .* mean 'my.sub:Ekf'"),
        (["bench", "--conditions", "nlso"], "--conditions: condition must be .* mean 'nlos'"),
        (["evaluate", "mounts", "--references", "rign"], "--references: reference must be one of"),
        # The progress has begun when the error is found.
        (["bounds", "--scene", "hal"], "--scene must be one of .* did you mean 'hall'"),
        (["place", "uwb_room", "--fewest"], "--fewest needs a requirement"),
        (["place", "F", "--fewest", "5"], "--fewest takes no value; .* by --anchors A..B"),
        (["place", "F", "--fewest=5"], "--fewest takes no value; .* by --anchors A..B"),
        (["place", "uwb_room", "--anchors", "x"], "--anchors: must be N or A..B, .* got 'x'"),
        (["convert", "--list", "x.bag"], "LOG must be given, before --list"),
        (["plac"], "did you mean 'place'"),
        (["train", "uwb_rom"], "did you mean 'uwb_room'"),
    ],
)
def test_an_error_is_one_line_that_names_the_option(arguments, message, capsys):
    error = said(capsys, *arguments)
    assert "\n" not in error
    assert re.match(rf"rbl-gym( {arguments[0]})?: .*{message}", error), error


def test_files_columns_and_values_keep_their_names():
    given = cli._parser("calibrate").parse_args(["calibrate", "--ranges", "bias_m.csv"])
    for text in (
        "bias_m.csv, line 2, column 'bias_m': must be a finite number, got 'x'",
        "out/bias_m.csv: cannot be read",
        "ranges must have at least one measured link, got none",
    ):
        assert cli.with_options(text, given, ["calibrate"]) == text
    assert cli.with_options("relative needs carrier; set planar", given, []) == (
        "relative needs --carrier; set --planar"
    )
    replay = cli._parser("replay").parse_args(["replay", "--ranges", "x.csv"])
    told = cli.with_options("imu needs the filter iekf-imu: leave out filter or imu", replay, [])
    assert told == "imu needs the filter iekf-imu: leave out --filter or --imu"
    told = cli.with_options("ranges or bias_m must be given", given, ["calibrate", "--ranges=x"])
    assert told == "--ranges or --bias-m must be given"


@pytest.mark.parametrize("command", ["", *cli._COMMANDS])
def test_help_fits_80_columns_and_breaks_no_word(command, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit, match="0"):
        cli.main([*filter(None, [command]), "--help"])
    text = capsys.readouterr().out
    # The usage lists choices, which have no spaces.
    lines = text.partition("\n\n")[2].splitlines()
    assert max(map(len, lines)) <= 80
    assert not [line for line in lines if re.search(r"\w-$", line)]
    assert text.count("show this help message") == 1


@pytest.mark.parametrize("command", cli._COMMANDS)
def test_every_option_has_a_help_and_numbers_have_a_default(command):
    parsers: Any = cli._parser(command)._subparsers
    parser = parsers._group_actions[0].choices[command]
    for action in parser._actions:
        assert action.help, action.dest
        default = action.default
        if isinstance(default, int | float) and not isinstance(default, bool) and action.type:
            assert "default" in action.help, action.dest
            assert f"{default:g}" in action.help, action.dest


def test_ctrl_c_ends_without_a_traceback(monkeypatch, capsys):
    def stop(arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "_run", stop)
    assert cli.main([]) == cli.INTERRUPTED
    assert capsys.readouterr().err == "rbl-gym: interrupted\n"


def test_a_missing_library_is_one_line(monkeypatch, capsys):
    def missing(arguments):
        raise ModuleNotFoundError("files with [[mounts]] need the package shapely: pip install ...")

    monkeypatch.setattr("rbl_gym.app.place_command._place", missing)
    assert said(capsys, "place", "--scene", "uwb_room").startswith("rbl-gym place: files with")


def test_a_value_with_a_minus_sign_in_front(capsys):
    error = said(capsys, "replay", *FILES, "--start", "-1,2,0.5")
    assert "expected one argument; with a minus sign in front, write --start=-1,2,0.5" in error


def test_folders_that_a_command_makes_are_named(tmp_path, capsys):
    track = tmp_path / "new" / "track.tum"
    assert cli.main(["replay", *FILES, "--track", str(track)]) == 0
    assert f"made the folder {track.parent}" in capsys.readouterr().err
    assert cli.main(["replay", *FILES, "--track", str(track)]) == 0
    assert "made the folder" not in capsys.readouterr().err


def test_a_survey_names_its_own_option_of_the_height(capsys):
    error = said(capsys, "calibrate", *FILES, "--planar", "--height-m", "1")
    assert "--height-offset-m" in error
