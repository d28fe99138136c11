"""The page of a table, from the records made up in tests/made_up_table; docs/results.md, from the committed ones."""

import csv
import json
import re
import runpy
import shutil
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from oodil.pipeline.errors import DataError
from oodil.pipeline.report.table import Table, read_table, write_table
from oodil.pipeline.report.table.figures import curve_over_seeds, method_looks, plots
from oodil.pipeline.report.table.grids import findings, grids, notes
from oodil.pipeline.report.table.making import Making, making
from oodil.pipeline.report.table.texts import explained, latex, main_table, markdown, over_seeds

ROOT = Path(__file__).parents[2]
MADE_UP = ROOT / "tests" / "made_up_table"
FILES = ("table.html", "table.md", "table.csv", "table.tex")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return Path(shutil.copytree(MADE_UP, tmp_path / "made-up"))


def changed(folder: Path, **values: Any) -> Table:
    """Return the table of the records with some values replaced."""
    path = folder / "results.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | values))
    return read_table(folder)


def grid(table: Table, title: str) -> list[tuple[str, ...]]:
    (found,) = [each for each in grids(table) if each.title == title]
    return [found.head, *found.rows]


def test_the_table_over_seeds():
    """Deviations: sqrt((200² + 100² + 0 + 100² + 200²) / 4) = 158; sqrt((160² + 60² + 40² + 40² + 140²) / 4) = 114."""
    assert main_table(read_table(MADE_UP)).splitlines() == [
        "|  | ours | naive GAIL | oracle |",
        "|---|---|---|---|",
        "| 1:1 | **300** ± 158 (250) | 210 ± 114 (**240**) | 600 ± 0 |",
        "| 1:9 | 1,015 ± 13 (**2,000**) | 20 ± 10 | 1,000 ± 79 |",
    ]


def test_five_seeds_have_an_interval_and_fewer_their_values():
    """The interquartile mean of five is that of the middle three: (200 + 300 + 400) / 3."""
    entries = read_table(MADE_UP).entries
    table = read_table(MADE_UP)
    found = entries["1:1", "imitation"].found
    assert found and found.interval and found.interquartile_mean == 300
    low, high = found.interval
    assert over_seeds(table, entries["1:1", "imitation"]) == f"IQM 300 ({low:.0f} to {high:.0f})"
    assert 100 <= low < 300 < high <= 500
    assert over_seeds(table, entries["1:9", "imitation"]) == "1,000 · 1,010 · 1,020 · 1,030, 4 of 5 seeds"
    assert over_seeds(table, entries["1:9", "naive_gail"]) == "10 · 20 · 30, 3 of 5 seeds"


def test_ours_is_compared_where_there_are_enough_seeds():
    """Of 25 pairs on 1:1, ours is better in 1 + 2 + 4 + 5 + 5 = 17; it never reaches the oracle's 600."""
    assert grid(read_table(MADE_UP), "Probability of improvement") == [
        ("", "over naive GAIL", "over oracle"),
        ("1:1", "0.68", "0.00"),
    ]


def test_scores_are_normalized_where_both_ends_are_known(folder: Path):
    """1:1: 300 of 600, 210 of 600, 600 of 600. With ends for 1:9, seeds 20 to 23 are those that both rows have."""
    rows = grid(read_table(MADE_UP), "Normalized score")[1:]
    assert rows == [("1:1", "0", "600", "50.0", "35.0", "100.0")]
    table = changed(folder, expert_return={"1:1": 600, "1:9": 900})
    # 100 (1000 + 100) / (900 + 100) = 110, 111, 112, 113 and, of 1:1, 16.7, 33.3, 50, 66.7: the middle four of eight.
    assert table.overall("imitation") == (pytest.approx((50 + 200 / 3 + 110 + 111) / 4), None)
    assert table.overall("oracle")[1] is not None
    # 11, 12, 13 and, of 1:1, 8.3, 25, 41.7: without the lowest and the highest.
    assert table.overall("naive_gail") == (pytest.approx((11 + 12 + 13 + 25) / 4), None)


def test_further_figures_and_sources():
    table = read_table(MADE_UP)
    head, ours, naive, *_ = grid(table, "Further figures")
    assert dict(zip(head, ours, strict=True)) == {
        "": "1:1",
        "method": "ours",
        "AUROC": "0.880 (0.500 to 1.000)",  # (0.5 + 0.9 + 3) / 5
        "transferable share": "10\u00a0% → 75\u00a0%",
        "effective number": "4.5",
        "purity": "1.000",
        "clusters in use": "2",
        "distance to the demonstrations": "0.250",
        "environment steps": "3\u00a0M",
    }
    assert naive[2] == "–" and naive[-1] == "1\u00a0M"
    assert grid(table, "Scores by source")[1:3] == [("1:1", "slow", "0.250 : 1.00"), ("1:1", "fast", "0.125 : 0.00")]


def test_what_is_better_is_counted_and_what_is_not_there_is_said():
    table = read_table(MADE_UP)
    assert list(findings(table)) == [
        "“ours” is at or above the paper in 1 of 2 rows. Below it: 1:9.",
        "“ours” is better than every other complete column but the oracle by more than the deviation over seeds in "
        "0 of 1 rows. Not: 1:1 (naive GAIL).",
    ]
    assert list(notes(table)) == [
        "Failed: 1:9, ours, seed 24: OSError: No space left on device",
        "Not there yet: 1:9; naive GAIL; seeds 23, 24",
    ]


def test_methods_and_rows_of_which_the_same_is_missing_are_named_together(folder: Path):
    missing = [["1:9", method, seed] for method in ("naive_gail", "imitation") for seed in (24, 23)]
    table = changed(folder, failed=[], missing=[*missing, ["1:9", "oracle", 23]])
    assert list(notes(table)) == [
        "Not there yet: 1:9; naive GAIL, ours; seeds 23, 24",
        "Not there yet: 1:9; oracle; seed 23",
    ]
    missing = [[row, method, 20] for row in ("1:1", "1:9") for method in ("naive_gail", "imitation", "oracle")]
    assert list(notes(changed(folder, cells=[], failed=[], missing=missing))) == [
        "Not there yet: 1:1, 1:9; all methods; seed 20"
    ]


def test_a_table_names_the_seeds_that_it_has(folder: Path):
    cells = [cell for cell in json.loads((MADE_UP / "results.json").read_text())["cells"] if cell["seed"] <= 21]
    assert "standard deviation over seeds 20, 21. " in explained(changed(folder, cells=cells))


def test_without_published_figures_the_best_of_a_row_is_marked(folder: Path):
    table = changed(folder, published={})
    assert table.marked == {("1:1", "oracle"): "found", ("1:9", "imitation"): "found"}
    assert "the best of each row" in markdown(table)
    shorter = changed(folder, figure="distance", published={"1:1": {"imitation": 0.2}})
    assert shorter.marked == {("1:1", "imitation"): "published"}, "the smaller distance is the better one"


def test_what_commands_have_in_common_is_said_once():
    made = read_table(MADE_UP).records.made
    command = "oodil table made-up --seeds 20-24"
    took = "2 runs of 1\u00a0min 30\u00a0s on average, 3\u00a0min 00\u00a0s in all"
    assert making(made) == Making(
        f"Each command: cores: 2; cpu: none; raw hopper steps per second: 12,100; took: {took}; versions: torch 0.0.",
        ((command, ""),),
    )
    later = {**made[0], "command": ["oodil", "table"], "machine": {"cores": 2, "cpu": "other"}, "seconds": {"a": 60}}
    both = making((*made, later, later | {"seconds": {}}))
    assert both.shared == "Each command: cores: 2; raw hopper steps per second: 12,100; versions: torch 0.0."
    assert both.commands == (
        (command, f"cpu: none; took: {took}"),
        ("oodil table", "cpu: other; took: 1 run of 1\u00a0min 00\u00a0s"),
        ("oodil table", "cpu: other"),
    )
    assert making(()) == Making("", ())


def test_the_page_stands_alone_and_follows_the_readers_mode(folder: Path):
    html = write_table(folder).read_text(encoding="utf-8")
    assert not re.search(r"<script|<link|@import|https?://|url\((?!#)", re.sub(r'xmlns(:\w+)?="[^"]*"', "", html))
    assert not re.search(r"\bnan\b", re.sub(r"<svg.*?</svg>", "", html, flags=re.DOTALL), re.IGNORECASE)
    assert "prefers-color-scheme: dark" in html and 'name="viewport"' in html
    drawn = re.findall(r"<svg.*?</svg>", html, re.DOTALL)
    assert len(drawn) == 4, "seeds and curves, each of two rows"
    for svg in drawn:
        ElementTree.fromstring(svg)
        assert not re.findall(r"(?<!,)#[0-9a-f]{6}\b", svg), "every color is a variable"
    for text in (
        "No space left on device",
        "1:9",
        "IQM 300",
        "Normalized score",
        "2 rows, 3 methods, 5 seeds: 27 of 30",
    ):
        assert text in html
    assert html.count("<b>") == 3


def test_equal_records_give_equal_files(folder: Path):
    write_table(folder)
    first = {name: (folder / name).read_bytes() for name in FILES}
    write_table(folder)
    assert first == {name: (folder / name).read_bytes() for name in FILES}


def test_every_cell_is_a_line_of_the_csv_file(folder: Path):
    write_table(folder)
    rows = list(csv.DictReader((folder / "table.csv").open(encoding="utf-8")))
    assert len(rows) == 27
    first = rows[0]
    assert (first["row"], first["method"], first["title"], first["seed"]) == ("1:1", "imitation", "ours", "20")
    assert (first["mean_return"], first["env_steps"], first["share_reached"]) == ("100", "3000000", "")
    assert (first["published"], rows[-1]["published"]) == ("250.0", "")


def test_latex_is_escaped_and_marks_in_bold(folder: Path):
    table = changed(folder, caption="50 % of a_b & c", source="Table 1, λ = 0.01")
    text = latex(table)
    assert r"1:1 & \textbf{300} $\pm$ 158 (250) & 210 $\pm$ 114 (\textbf{240}) & 600 $\pm$ 0 \\" in text
    assert r"\caption{50 \% of a\_b \& c Mean return:" in text and r"(Table 1, $\lambda$ = 0.01)" in text
    assert text.count("{") == text.count("}") and r"\toprule" in text


def test_markdown_is_escaped(folder: Path):
    values = json.loads((folder / "results.json").read_text())
    assert r"a\|b \*c\*" in markdown(changed(folder, methods=values["methods"] | {"oracle": "a|b *c*"}))


def test_curves_are_joined_at_the_steps_of_any_seed(folder: Path):
    table = read_table(MADE_UP)
    steps, returns = curve_over_seeds(table, "1:9", "naive_gail")
    np.testing.assert_array_equal(steps, [0, 500_000, 1_000_000])
    np.testing.assert_array_equal(returns, [[0, 5, 10], [0, 10, 20], [0, 15, 30]])
    cells = json.loads((folder / "results.json").read_text())["cells"][:2]
    cells[0]["curve"] = {"env_steps": [0, 10, 20, 30], "mean_return": [0, None, 40, 60]}
    cells[1]["curve"] = {"env_steps": [5, 20], "mean_return": [1, 4]}
    steps, returns = curve_over_seeds(changed(folder, cells=cells), "1:1", "imitation")
    np.testing.assert_array_equal(steps, [5, 20])  # 0 and 30 are beyond the other seed's, 10 is not finite
    np.testing.assert_allclose(returns, [[10, 40], [1, 4]])


def swept(folder: Path, values: list[str]) -> Table:
    """Return the table with its first row's cells repeated at the values of a parameter."""
    cells = [cell for cell in json.loads((folder / "results.json").read_text())["cells"] if cell["row"] == "1:1"]
    rows = [f"lambda = {value}" for value in values]
    cells = [cell | {"row": row} for row in rows for cell in cells]
    return changed(folder, rows=rows, cells=cells, published={rows[0]: {"imitation": 1}}, failed=[], missing=[])


@pytest.mark.parametrize(
    ("values", "logarithmic"), [(["0.001", "3", "1e-2"], True), (["1", "100"], False), (["0", "1_000"], False)]
)
def test_rows_that_are_values_of_one_parameter_are_a_sweep(folder: Path, values: list[str], logarithmic: bool):
    table = swept(folder, values)
    assert table.sweep and table.sweep.key == "lambda"
    assert list(table.sweep.values.values()) == [float(value) for value in values]
    assert table.sweep.logarithmic is logarithmic
    assert [plot.name for plot in plots(table)] == ["sweep", "clusters", "curves"]
    ((_, svg),) = plots(table)[0].each()
    assert all(f">{float(value):g}<" in svg for value in values) and ">lambda<" in svg
    assert "Over the values" in write_table(folder).read_text(encoding="utf-8")


def test_other_rows_are_no_sweep(folder: Path):
    table = read_table(MADE_UP)
    assert table.sweep is None
    assert [plot.name for plot in plots(table)] == ["seeds", "curves"]
    records = table.records
    for rows in (("K = 1", "lambda = 1"), ("K = 1",), ("K = 1", "K = many"), ("K = 1", "other")):
        assert Table(records.model_copy(update={"rows": rows})).sweep is None


def test_the_oracle_is_dashed_and_ours_comes_first():
    looks = method_looks(read_table(MADE_UP))
    assert list(looks) == ["imitation", "naive_gail", "oracle"]
    assert [look.dashes for look in looks.values()] == ["solid", "solid", "dashed"]
    assert len({look.color for look in looks.values()}) == 3


def test_a_table_of_one_unfinished_run_is_a_page_too(folder: Path):
    table = changed(folder, cells=[], failed=[], missing=[["1:1", "imitation", 20]], published={})
    assert not plots(table) and not grids(table) and not list(findings(table))
    assert "Not there yet: 1:1; ours; seed 20" in write_table(folder).read_text(encoding="utf-8")
    cells = json.loads((MADE_UP / "results.json").read_text())["cells"][:1]
    changed(folder, cells=cells, published={"1:9": {"oracle": 7}})
    (folder / "made.json").unlink()
    html = write_table(folder).read_text(encoding="utf-8")
    assert '<span class="deviation">' not in html and "How it was made" not in html


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"figure": "speed"}, "figure: 'speed' is none of mean_return, share_reached"),
        ({"rows": []}, "a table needs a row and a method"),
        ({"cells": [{"row": "x", "method": "oracle", "seed": 20}]}, r"\('x', 'oracle', 20\) is in no row"),
        ({"cells": [{"row": "1:1", "method": "oracle", "seed": 20}] * 2}, r"\('1:1', 'oracle', 20\) is there twice"),
        ({"cells": [{"row": "1:1", "method": "oracle", "seed": "a"}]}, r"cells\.0\.seed: "),
        ({"missing": [["1:1", "oracle", 7]]}, r"\('1:1', 'oracle', 7\), is in no cell"),
    ],
)
def test_records_that_are_not_as_described_are_refused(folder: Path, values: dict[str, Any], message: str):
    path = folder / "results.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | values))
    with pytest.raises(DataError, match=f"{re.escape(str(path))}: .*{message}"):
        write_table(folder)
    assert not list(folder.glob("table.*"))


def test_a_folder_without_records_is_refused(tmp_path: Path):
    with pytest.raises(DataError, match=r"results\.json: No such file"):
        write_table(tmp_path)
    (tmp_path / "results.json").write_text("{")
    with pytest.raises(DataError, match="not valid JSON"):
        write_table(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "expected a list"),
        ("[{}]", "every entry needs the seconds"),
        ('[{"seconds": {"a": "1"}}]', "every entry needs the seconds"),
        ('[{"seconds": {}, "command": null}]', "every entry .* a command is a list"),
        ('[{"seconds": {}, "machine": "x"}]', "every entry .* a machine an object"),
    ],
)
def test_what_is_known_of_its_making_is_as_described(folder: Path, text: str, message: str):
    (folder / "made.json").write_text(text)
    with pytest.raises(DataError, match=f"{re.escape(str(folder / 'made.json'))}: {message}"):
        write_table(folder)


def test_the_results_in_the_docs_are_those_that_are_committed():
    """If this fails, run ``python docs/make_results.py``."""
    script = runpy.run_path(str(ROOT / "docs" / "make_results.py"))
    assert (ROOT / "docs" / "results.md").read_text(encoding="utf-8") == script["page"]()
    drawn = {path.name: path.read_text(encoding="utf-8") for path in (ROOT / "docs" / "results").glob("*")}
    assert drawn.keys() == set(re.findall(r"\(results/([^)]+)\)", script["page"]()))
    assert drawn == {name: f"{svg}\n" for name, svg in script["figures"]().items()}
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert readme == script["readme"](readme)


def test_the_readme_has_the_rows_with_enough_seeds(folder: Path):
    script = runpy.run_path(str(ROOT / "docs" / "make_results.py"))
    text = f"above{script['BEGINNING']}old{script['END']}below"
    made = script["readme"](text, folder.parent)
    assert made.startswith(f"above{script['BEGINNING']}") and made.endswith(f"{script['END']}below")
    (row,) = [line for line in made.splitlines() if "made-up" in line]
    assert row.startswith(
        "| [A fixture of the tests: nobody measured these figures.](docs/results.md#made-up), 1:1 | 20 to 24 | "
    )
    assert "**300** (IQM 300 (167 to 467)) | 210 (IQM 217 (117 to 317)) |" in row
    assert row.endswith("| 10 % -> 75 % |") and "old" not in made
    assert script["readme"](made, folder.parent) == made
    assert script["readme"](text, folder / "empty") == text


def test_ranges_of_seeds():
    ranges = runpy.run_path(str(ROOT / "docs" / "make_results.py"))["ranges"]
    assert [ranges(seeds) for seeds in ([20, 21, 22], [3], [0, 1, 4, 7, 8])] == ["20 to 22", "3", "0 to 1, 4, 7 to 8"]


def test_the_results_page_says_what_is_better_than_the_paper_and_what_is_not(folder: Path):
    (folder / "notes.md").write_text("Too few seeds.\n")
    script = runpy.run_path(str(ROOT / "docs" / "make_results.py"))
    page = script["page"](folder.parent)
    better, worse = page.split("## Below the paper")
    assert "| made-up, 1:1 | 300 | 250 | +50 | 100, 200, 300, 400, 500 |" in better
    assert "| made-up, 1:9 | 1,015 | 2,000 | −985 |" in worse
    assert "### Why\n\nToo few seeds." in worse and "![seeds: made-up](results/made-up-seeds.svg)" in worse
    for svg in script["figures"](folder.parent).values():
        ElementTree.fromstring(svg)


def test_tables_of_several_machines_are_kept_together(folder: Path, tmp_path: Path):
    """In row 1:1 ours is made anew with seed 24 and the oracle gets another seed; row 1:9 was not asked for."""
    keep = runpy.run_path(str(ROOT / "docs" / "keep_table.py"))["keep"]
    kept = tmp_path / "experiments"
    keep(folder, kept)
    first = json.loads((MADE_UP / "results.json").read_text())
    assert json.loads((kept / "made-up" / "results.json").read_text()) == first
    places = ("1:1", "imitation", 24), ("1:1", "oracle", 24)
    ours, oracle = (next(c for c in first["cells"] if (c["row"], c["method"], c["seed"]) == place) for place in places)
    cells = [ours | {"mean_return": 501}, oracle | {"seed": 25}]
    missing = [["1:1", "imitation", 25], ["1:9", "imitation", 25], ["1:9", "oracle", 24]]
    changed(folder, cells=cells, failed=[], missing=missing, seeds=[24, 25])
    command = ["oodil", "table", "made-up", "--seeds", "24-25"]
    (folder / "made.json").write_text(json.dumps([{"command": command, "seconds": {}}]))
    for _ in range(2):
        keep(folder, kept)
        joined = read_table(kept / "made-up")
        assert [made["command"][-1] for made in joined.records.made] == ["20-24", "24-25"]
        assert len(joined.records.cells) == len(first["cells"]) + 1
        returns = joined.by_seed("1:1", "imitation", "mean_return")
        assert returns == {20: 100, 21: 200, 22: 300, 23: 400, 24: 501}
        assert list(joined.by_seed("1:1", "oracle", "mean_return")) == [20, 21, 22, 23, 24, 25]
        assert [(each.row, each.method, each.seed) for each in joined.records.failed] == [("1:9", "imitation", 24)]
        assert joined.records.missing == (
            ("1:1", "imitation", 25),
            ("1:9", "naive_gail", 23),
            ("1:9", "naive_gail", 24),
        )


def test_a_cell_that_had_failed_or_was_missing_is_kept_once_it_is_there(folder: Path, tmp_path: Path):
    keep = runpy.run_path(str(ROOT / "docs" / "keep_table.py"))["keep"]
    keep(folder, tmp_path / "experiments")
    cells = json.loads((MADE_UP / "results.json").read_text())["cells"]
    new = [
        next(c for c in cells if (c["row"], c["method"]) == ("1:9", method)) | {"seed": 24}
        for method in ("imitation", "naive_gail")
    ]
    changed(folder, cells=new, failed=[], missing=[])
    keep(folder, tmp_path / "experiments")
    joined = read_table(tmp_path / "experiments" / "made-up")
    assert not joined.records.failed and joined.records.missing == (("1:9", "naive_gail", 23),)
    assert len(joined.records.cells) == len(cells) + 2


def test_records_that_are_not_as_described_are_not_kept(folder: Path, tmp_path: Path):
    keep = runpy.run_path(str(ROOT / "docs" / "keep_table.py"))["keep"]
    (folder / "made.json").write_text("{}")
    with pytest.raises(DataError, match=r"made\.json: expected a list, found a dict"):
        keep(folder, tmp_path / "experiments")
    assert not (tmp_path / "experiments").exists()


@pytest.mark.parametrize("alone", [("imitation", "naive_gail", "oracle"), ("imitation",), ("naive_gail",)])
def test_a_single_seed_has_no_deviation_to_be_compared_by(folder: Path, alone: tuple[str, ...]):
    cells = [
        each
        for each in json.loads((folder / "results.json").read_text())["cells"]
        if each["row"] == "1:1" and (each["seed"] == 20 or each["method"] not in alone)
    ]
    table = changed(folder, cells=cells, missing=[], failed=[])
    assert table.entries["1:1", "imitation"].found and table.entries["1:1", "naive_gail"].found
    assert not any("deviation" in each for each in findings(table))
