"""A table is the same bytes whatever happens on the way, with real processes and real signals."""

import json
import shutil
import signal
from pathlib import Path

import pytest

import oodil
from oodil.experiments import Table
from oodil.pipeline.experiment import load_experiment
from oodil.whole_runs import LEAST_STEPS
from oodil.workers.local_engine import LocalEngine
from oodil.workers.reports import Event, Progress
from tests.runs import LiveRun, artifacts, has_checkpoint, interrupt, nothing_left, run, wait_for, without_baselines
from tests.tables import RUNS, SHORT, write_experiment

pytestmark = pytest.mark.timeout(600)


def command(folder: Path, workers: int, *options: str) -> list[str]:
    return ["table", str(folder / "experiment.yaml"), "--folder", str(folder), "--workers", str(workers), *options]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a table that nothing disturbed, made by one process."""
    folder = tmp_path_factory.mktemp("whole")
    write_experiment(folder)
    run(*command(folder, 1))
    return folder / "micro"


def test_what_a_table_says(whole: Path) -> None:
    found = json.loads((whole / "results.json").read_bytes())
    assert list(found["methods"].items()) == [("naive_gail", "naive GAIL"), ("ours", "ours")]
    assert (found["rows"], found["seeds"], found["figure"]) == (["some", "all"], [0, 1], "mean_return")
    assert found["published"] == {"all": {"ours": 3000.0}} and not found["failed"] and not found["missing"]
    assert [(cell["row"], cell["method"], cell["seed"]) for cell in found["cells"]] == [
        (row, method, seed) for row in ("some", "all") for method in ("naive_gail", "ours") for seed in (0, 1)
    ]
    results = oodil.open_run(whole / "all-seed1")
    naive, ours = (c for c in found["cells"] if (c["row"], c["seed"]) == ("all", 1))
    assert ours["mean_return"] == results.evaluation().mean_return
    told = results.separation()
    assert (ours["auroc"], ours["share_after"]) == (told["auroc"], told["share"])
    assert ours["sources"].keys() == ours["scores"].keys() == {"first obstacle wider", "five times as fast"}
    # 3,200 steps are 10 iterations of 4 x 4 x 20. The episodes by which they are measured come on top; for ours, the
    # clusters' imitators and the readings of their scores, too.
    steps = results.env_steps()
    assert naive["env_steps"] == steps["naive_gail"] > results.policy("naive_gail").env_steps == 3_200
    assert ours["env_steps"] == sum(steps.values()) - steps["naive_gail"] > naive["env_steps"]
    assert 0 <= naive["share_reached"] <= 1
    assert naive["auroc"] is None and naive["sources"] == {} and naive["curve"]["env_steps"] == [3_200]
    assert found["random_return"]["some"] == found["random_return"]["all"] < found["expert_return"]["all"]
    (made,) = json.loads((whole / "made.json").read_bytes())
    assert made["seconds"].keys() == RUNS


def test_an_unchanged_table_computes_nothing(whole: Path) -> None:
    before = {name: artifacts(whole / name) for name in RUNS}
    kept = [whole / "results.json", whole / "made.json", whole / "all-seed0" / "events.jsonl"]
    contents = [path.read_bytes() for path in kept]
    table = Table.of(load_experiment(str(whole.parent / "experiment.yaml")), whole)
    assert table.unfinished(table.select(None, None)) == {}
    run(*command(whole.parent, 2))
    table.write_made(["table"])  # A command that was stopped before it had finished a stage.
    assert [path.read_bytes() for path in kept] == contents
    assert {name: artifacts(whole / name) for name in RUNS} == before


def test_what_is_computed_again_is_in_how_it_was_made(whole: Path, tmp_path: Path) -> None:
    write_experiment(tmp_path)
    shutil.copytree(whole, tmp_path / "micro")
    for finished in ("stages", "jobs"):
        shutil.rmtree(tmp_path / "micro" / "all-seed1" / finished / "imitation")
    shutil.rmtree(tmp_path / "micro" / "some-seed0")
    run(*command(tmp_path, 1))
    earlier, again = json.loads((tmp_path / "micro" / "made.json").read_bytes())
    assert [earlier] == json.loads((whole / "made.json").read_bytes())
    assert again["seconds"].keys() == {"all-seed1", "some-seed0"}
    anew = oodil.open_run(tmp_path / "micro" / "some-seed0").seconds_ever()
    assert again["seconds"]["some-seed0"] == pytest.approx(anew, abs=0.1), "what was there before it counts no more"
    run(*command(tmp_path, 1))
    assert len(json.loads((tmp_path / "micro" / "made.json").read_bytes())) == 2


@pytest.mark.parametrize(
    ("job", "stage", "training", "workers", "workers_after"),
    [("some-seed1", "imitation", "training-1", 2, 1), ("some-seed0", "imitators", "cluster-0", 1, 2)],
)
def test_killed_and_resumed_with_other_workers(
    whole: Path, tmp_path: Path, job: str, stage: str, training: str, workers: int, workers_after: int
) -> None:
    write_experiment(tmp_path)
    live = LiveRun(*command(tmp_path, workers))
    wait_for(has_checkpoint(tmp_path / "micro" / job, stage, training, 2), "checkpoint")
    live.kill_group()
    nothing_left(live)
    assert not (tmp_path / "micro" / "results.json").exists()
    run(*command(tmp_path, workers_after))
    assert (tmp_path / "micro" / "results.json").read_bytes() == (whole / "results.json").read_bytes()


def test_an_interrupt_stops_politely(whole: Path, tmp_path: Path) -> None:
    write_experiment(tmp_path)
    live = LiveRun(*command(tmp_path, 2))
    wait_for(has_checkpoint(tmp_path / "micro" / "some-seed0", "imitators", "cluster-0", 2), "checkpoint")
    interrupt(live, signal.SIGINT)
    code, output = live.finish()
    assert code == 130, output
    assert "4 not finished" in output and f"go on with: oodil table {tmp_path}" in output
    nothing_left(live)
    found = json.loads((tmp_path / "micro" / "results.json").read_bytes())
    assert not found["cells"] and not found["failed"] and len(found["missing"]) == 8
    # What is asked for is all that is computed; what is there already is shown.
    code, output = LiveRun(*command(tmp_path, 1, "--rows", "all", "--methods", "naive_gail")).finish()
    assert code == 0, output
    assert len(json.loads((tmp_path / "micro" / "results.json").read_bytes())["cells"]) == 2
    run(*command(tmp_path, 2))
    assert (tmp_path / "micro" / "results.json").read_bytes() == (whole / "results.json").read_bytes()
    interrupted, part, rest = json.loads((tmp_path / "micro" / "made.json").read_bytes())
    assert part["command"][-4:] == ["--rows", "all", "--methods", "naive_gail"]
    assert part["seconds"].keys() == {"all-seed0", "all-seed1"} and rest["seconds"].keys() == RUNS
    spent = {name: sum(oodil.open_run(tmp_path / "micro" / name).seconds().values()) for name in RUNS}
    said = {name: sum(each["seconds"].get(name, 0) for each in (interrupted, part, rest)) for name in RUNS}
    assert said == pytest.approx(spent, abs=0.2)


def test_progress_is_that_of_what_is_left(tmp_path: Path) -> None:
    """A run whose baseline is there begins at nothing done, and ends with as many steps as its other stages take."""
    write_experiment(tmp_path, rows={"only": []}, seeds=0, published={})
    table = Table.of(load_experiment(tmp_path / "experiment.yaml"), tmp_path / "micro")
    for methods in (["naive_gail"], None):
        events: list[Event] = []
        selected = table.unfinished(table.select(None, methods))
        left = [
            stage for stage in selected["only-seed0"] if methods or stage.name not in ("demonstrations", "naive_gail")
        ]
        expected = sum(max(stage.cost(table.runs[0].config).env_steps, LEAST_STEPS) for stage in left)
        table.compute(selected, LocalEngine(0), events.append, lambda: False)
        told = [event.report for event in events if isinstance(event.report, Progress)]
        assert {each.total for each in told} == {expected} and told[-1].done == expected
        assert [each.done for each in told] == sorted(each.done for each in told)


def test_what_runs_have_in_common_is_computed_once(tmp_path: Path) -> None:
    """A method with overrides takes over all but its own policy, and has the bits of an ordinary run."""
    variant = {"name": "kept", "policy": "imitation", "overrides": ["transferability.kept_from=0"]}
    write_experiment(tmp_path, rows={"only": []}, methods=["imitation", variant], seeds=0, published={})
    run(*command(tmp_path, 2))
    computed: dict[str, list[str]] = {}
    for name in ("only-seed0", "only-kept-seed0"):
        events = map(json.loads, (tmp_path / "micro" / name / "events.jsonl").read_text().splitlines())
        for event in events:
            if event["event"] == "stage_started" and event["jobs"]:
                computed.setdefault(event["stage"], []).append(name)
    assert {stage: len(runs) for stage, runs in computed.items()} == {
        "demonstrations": 1,
        "clustering": 1,
        "imitators": 1,
        "transferability": 1,
        "imitation": 2,
    }
    table = Table.of(load_experiment(tmp_path / "experiment.yaml"), tmp_path / "micro")
    kept = next(planned for planned in table.runs if planned.name == "only-kept-seed0")
    alone = oodil.run(kept.config, workers=0, run_dir=tmp_path / "alone")
    assert artifacts(alone.path) == artifacts(tmp_path / "micro" / "only-kept-seed0")


def test_what_a_table_beside_it_has_finished_is_taken_over(whole: Path, tmp_path: Path) -> None:
    experiment = str(write_experiment(tmp_path, name="second", seeds=1, methods=["imitation"], published={}))
    options = ["--folder", str(whole.parent), "--workers", "1"]
    unreadable = json.loads((whole / "all-seed1" / "config.json").read_bytes())
    unreadable["demonstrations"] |= {"sources": [], "file": "/nowhere/recorded.safetensors"}
    for name, text in (("lost", json.dumps(unreadable)), ("foreign", "[]")):
        (whole.parent / "aside" / name).mkdir(parents=True, exist_ok=True)
        (whole.parent / "aside" / name / "config.json").write_text(text)
    assert "2 runs: 0 stages to compute, 0 to take over, 10 finished" in run("table", experiment, *options, "--plan")
    run("table", experiment, *options)
    for name in ("some-seed1", "all-seed1"):
        events = (whole.parent / "second" / name / "events.jsonl").read_text()
        assert "run_finished" in events and "stage_started" not in events
        assert artifacts(whole.parent / "second" / name) == without_baselines(artifacts(whole / name))


def test_one_that_fails_leaves_the_others_alone_and_is_named(tmp_path: Path) -> None:
    never = "tests.raising:never"
    write_experiment(tmp_path, rows={"only": [], "other": []}, methods=[never, "naive_gail"], seeds=0, published={})
    code, output = LiveRun(*command(tmp_path, 2)).finish()
    assert code == 1, output
    assert "0 runs done, 2 failed (only-seed0, other-seed0), 0 not finished" in output
    found = json.loads((tmp_path / "micro" / "results.json").read_bytes())
    reason = "raising: ArithmeticError: no weights today"
    assert found["failed"] == [
        {"row": row, "seed": 0, "method": "never", "reason": reason} for row in ("only", "other")
    ]
    assert [(cell["row"], cell["method"]) for cell in found["cells"]] == [
        ("only", "naive_gail"),
        ("other", "naive_gail"),
    ]


def test_another_configuration_is_refused(whole: Path) -> None:
    write_experiment(whole.parent, overrides=[*SHORT, "imitation.gail.discount=0.9"])
    before = (whole / "results.json").read_bytes()
    code, output = LiveRun(*command(whole.parent, 1)).finish()
    write_experiment(whole.parent)
    assert code == 2, output
    assert "is finished with other settings (gail.discount 0.995 -> 0.9); choose another --folder" in output
    assert (whole / "results.json").read_bytes() == before


def test_a_folder_that_says_nothing_of_its_making_is_refused_before_any_work(tmp_path: Path) -> None:
    write_experiment(tmp_path)
    (tmp_path / "micro").mkdir()
    (tmp_path / "micro" / "made.json").write_text("{}")
    code, output = LiveRun(*command(tmp_path, 1)).finish()
    assert code == 2 and "made.json: expected a list, found a dict" in output, output
    assert [path.name for path in (tmp_path / "micro").iterdir()] == ["made.json"]


def test_a_plan_computes_nothing(tmp_path: Path) -> None:
    write_experiment(tmp_path)
    output = run(*command(tmp_path, 1, "--plan", "--rows", "all"))
    assert "2 runs: 12 stages to compute, 0 to take over, 0 finished" in output
    assert "with 1 runs at once; by a short measurement" in output
    assert [path.name for path in tmp_path.iterdir()] == ["experiment.yaml"]
