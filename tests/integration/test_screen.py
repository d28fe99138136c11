"""What a person sees of a run: on terminals of several widths, on poor ones, and in a file."""

import itertools
import os
import re
import subprocess
import sys
from pathlib import Path

import pyte
import pytest

from tests.runs import ROOT
from tests.terminals import RunInTerminal

MANY = str(ROOT / "tests" / "many_stages.py")
STAGES, JOBS = 200, 4


def frames(written: str, columns: int, lines: int = 24) -> list[list[str]]:
    """Return what stands on the screen whenever the line of the whole run has been drawn, for the first 600 times."""
    screen, found, last = pyte.Screen(columns, lines), [], 0
    stream = pyte.Stream(screen)
    for drawn in itertools.islice(re.finditer(r"whole run[^\n\r]*", written), 600):
        stream.feed(written[last : drawn.end()])
        last = drawn.end()
        found.append([line.rstrip() for line in screen.display if line.strip()])
    return found


@pytest.mark.parametrize(("columns", "figures"), [(80, 1), (100, 2), (120, 3)])
def test_no_line_is_lost_or_doubled_and_what_matters_has_room(columns: int, figures: int) -> None:
    live = RunInTerminal(str(STAGES), str(JOBS), program=MANY, columns=columns)
    code, written = live.finish()
    assert code == 0, written
    seen = [line for line in live.screen(written) if line]
    told = [line for line in seen if line[0] in "▶✓"]
    assert told == [line for n in range(STAGES) for line in (f"▶ stage-{n} ({JOBS} jobs)", f"✓ stage-{n}: 1.0 s")]
    assert not [line for line in seen if "eta" in line], "no bar stays behind"
    assert [line for line in seen if line.startswith("printed")] == [f"printed {n}" for n in range(0, STAGES, 50)]
    assert sum("[of a kind]" in line for line in seen) == STAGES // 50
    full = [frame for frame in frames(written, columns) if "cluster-3-training-2 " in frame[-2]]
    assert len(full) > 20
    for frame in full:
        for line in frame[-2:]:
            assert re.match(r"  (cluster-3-training-2|whole run) +[━─]{10,24} +\d+%  eta [\d:-]+", line), line
            assert len(line) <= columns - 4
    told = ("return 1,234", "/s", "length 111.2", "loss 16.33")
    assert max(sum(each in frame[-2] for each in told) for frame in full) == figures


def test_the_whole_run_has_a_bar_and_a_time_that_go_one_way() -> None:
    live = RunInTerminal("40", "2", program=MANY, columns=100)
    _, written = live.finish()
    lines = [frame[-1] for frame in frames(written, 100)]
    shares = [int(re.search(r"(\d+)%", line).group(1)) for line in lines]  # type: ignore[union-attr]
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] >= 97
    assert "stage 1 of 40" in lines[0] and "stage 40 of 40" in lines[-1]


def piped(environment: dict[str, str]) -> str:
    """Return what many stages write into a file."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("LC_", "LANG"))}
    done = subprocess.run(
        [sys.executable, MANY, "60", str(JOBS)],
        check=True,
        capture_output=True,
        env=inherited | {"LANG": "C.UTF-8"} | environment,
    )
    return done.stdout.decode()


@pytest.mark.parametrize("environment", [{}, {"FORCE_COLOR": "1"}])
def test_a_file_gets_lines_with_times_and_no_bars(environment: dict[str, str]) -> None:
    written = piped(environment)
    assert "\r" not in written and "━" not in written and "\x1b[1A" not in written
    plain = re.sub(r"\x1b\[[\d;]*m", "", written).splitlines()
    assert sum("✓ stage-" in line for line in plain) == 60
    assert all(re.match(r"\d\d:\d\d:\d\d  ", line) for line in plain if not line.startswith("printed"))
    # By the clock of the display a stage takes 16 reports of a quarter of a second: 240 s in all, and a line in 30 s.
    now_and_then = [line for line in plain if "whole run" in line]
    assert 7 <= len(now_and_then) <= 8
    assert re.search(r"whole run +\d+%  eta [\d:]+ +stage \d+ of 60", now_and_then[-1])


@pytest.mark.parametrize(
    "environment",
    [
        {"LANG": "C"},
        {"LC_ALL": "POSIX"},
        {"TERM": "dumb"},
        {"PYTHONIOENCODING": "ascii"},
        {"PYTHONIOENCODING": "latin-1"},
    ],
)
def test_ascii_where_there_is_no_more(environment: dict[str, str]) -> None:
    written = piped(environment)
    assert written.isascii()
    assert sum("ok stage-" in line for line in written.splitlines()) == 60


def test_a_terminal_that_cannot_move_its_cursor_is_like_a_file() -> None:
    live = RunInTerminal("60", str(JOBS), program=MANY, environment={"TERM": "dumb"})
    code, written = live.finish()
    assert code == 0 and written.isascii() and "\x1b" not in written
    assert len(re.findall(r"\d\d:\d\d:\d\d  ok stage-", written)) == 60


def test_ascii_bars_on_a_terminal() -> None:
    live = RunInTerminal("20", "2", program=MANY, environment={"LANG": "C", "LC_ALL": "C"})
    code, written = live.finish()
    assert code == 0 and written.isascii()
    assert re.search(r"whole run +#+-+ +\d+%", re.sub(r"\x1b\[[\d;]*m", "", written))
    assert sum(line.startswith("ok stage-") for line in live.screen(written)) == 20


def test_what_a_table_shows_is_ascii_too(tmp_path: Path) -> None:
    """Every command goes through the same door, whatever it prints."""
    (tmp_path / "program.py").write_text(
        "from oodil.cli.encoding import fit_encoding\nfit_encoding()\nprint('3 ± 1, grün')\n"
    )
    found = subprocess.run(
        [sys.executable, str(tmp_path / "program.py")],
        check=True,
        capture_output=True,
        env=os.environ | {"PYTHONIOENCODING": "ascii"},
    )
    assert found.stdout == b"3 +- 1, gr\\xfcn\n"
