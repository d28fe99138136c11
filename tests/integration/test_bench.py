"""`oodil bench` runs the real learner with each number of workers and names one of them."""

from tests.runs import MICRO, run

SMALL = ("imitation.gail.num_groups=2", "imitation.gail.simulators_per_group=1")


def test_each_number_of_workers_has_its_row_and_one_is_named() -> None:
    output = run("bench", str(MICRO), *SMALL, "--workers", "0", "--workers", "2")
    rows = [
        line.split() for line in output.splitlines() if "times" not in line and ("inline" in line or line[2:4] == "2 ")
    ]
    assert [row[0] for row in rows] == ["0", "2"]
    rates = [float(row[2 if row[0] == "0" else 1].replace(",", "")) for row in rows]
    assert min(rates) > 0
    marked = [row[0] for row in rows if "--workers" in row]
    assert marked == ["0" if rates[0] > rates[1] else "2"]
