"""Who imports whom, and what must appear nowhere: read from the sources, not from what happens to be loaded."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROCESS_MODULES = {"multiprocessing", "subprocess", "concurrent", "joblib"}
PROCESS_CALLS = {"os.fork", "os.forkpty", "os.system", "os.popen", "pty.fork", "pty.spawn"}
PROCESS_PREFIXES = ("os.exec", "os.spawn", "os.posix_spawn", "torch.multiprocessing")
UNSAFE_MODULES = {
    "pickle",
    "_pickle",
    "cPickle",
    "dill",
    "cloudpickle",
    "jsonpickle",
    "msgpack_numpy",
    "shelve",
    "marshal",
}
UNSAFE_CALLS = {"torch.load", "torch.save", "yaml.load", "yaml.unsafe_load", "yaml.full_load", "np.load", "numpy.load"}
UNSAFE_METHODS = {"send_pyobj", "recv_pyobj"}
COMMAND_LINE = ("cli", "terminal", "bench", "experiments", "whole_runs", "estimate")
TOP = ("orchestrator", *COMMAND_LINE)
BOTTOM = {
    "errors": (),
    "config": (),
    "seeding": (),
    "policy": (),
    "artifacts": ("errors",),
    "data": ("errors", "policy", "seeding"),
}
"""What the files at the bottom of the pipeline may import of ours."""
CONVERTERS = {"pipeline/datasets/official.py"}
"""The one file that may read foreign pickles."""


def sources() -> list[str]:
    """Return all source files of the program, relative to the root, each under one name: links are not followed."""
    folders = ("pipeline", "workers", "examples", "src/oodil/cli", "src/oodil/terminal")
    found = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    found += [path for path in (ROOT / "src" / "oodil").glob("*.py") if not path.is_symlink()]
    return sorted(str(path.relative_to(ROOT)) for path in [*found, *ROOT.glob("*.py")])


def parse(name: str) -> ast.Module:
    return ast.parse((ROOT / name).read_text(), name)


def imported(tree: ast.Module) -> Iterator[str]:
    """Yield the full name of everything that is imported anywhere in a file; no file imports relatively."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "relative import"
            assert node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def called(tree: ast.Module) -> Iterator[tuple[str, ast.Call]]:
    """Yield each call with the dotted name of what is called."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


def packages(tree: ast.Module) -> set[str]:
    return {name.split(".")[0] for name in imported(tree)}


def forbidden_imports(name: str, tree: ast.Module) -> set[str]:
    """Return what a file imports against the order command line -> orchestrator -> workers -> pipeline.

    Nothing imports ``pipeline`` or ``workers`` by themselves: a module would then exist twice.
    """
    used = set(imported(tree))
    found = {each for each in used if each.split(".")[0] in ("pipeline", "workers", "orchestrator")}
    above = {"pipeline": ("workers", *TOP), "workers": TOP, "orchestrator.py": COMMAND_LINE}
    if name == "orchestrator.py":
        used -= {"oodil.cli.main"}  # ``python orchestrator.py`` is the command line
    higher = tuple(f"oodil.{module}" for module in above.get(name.split("/")[0], ()))
    return found | {each for each in used if each.startswith(higher)}


def starts_processes(tree: ast.Module) -> set[str]:
    """Return by what a file could start processes."""
    names = {*imported(tree), *(name for name, _ in called(tree))}
    return (packages(tree) & PROCESS_MODULES) | {
        name for name in names if name in PROCESS_CALLS or name.startswith(PROCESS_PREFIXES)
    }


def unpickles(tree: ast.Module) -> set[str]:
    """Return by what a file could turn bytes into code."""
    found = packages(tree) & UNSAFE_MODULES
    found |= set(imported(tree)) & UNSAFE_CALLS
    for name, call in called(tree):
        if name in UNSAFE_CALLS - {"np.load", "numpy.load"} or name.split(".")[-1] in UNSAFE_METHODS:
            found.add(name)
        for keyword in call.keywords:
            if keyword.arg == "allow_pickle" and not (
                isinstance(keyword.value, ast.Constant) and keyword.value.value is False
            ):
                found.add(f"{name}(allow_pickle)")
            if keyword.arg == "weights_only":
                found.add(f"{name}(weights_only)")
    return found


def test_the_program_is_found():
    assert {"orchestrator.py", "pipeline/config/run.py", "pipeline/algorithms/trpo.py"} <= set(sources())
    assert any(name.startswith("workers/") for name in sources())


@pytest.mark.parametrize("name", sources())
def test_imports_run_one_way(name):
    assert not forbidden_imports(name, parse(name))


def test_one_file_knows_zeromq():
    assert [name for name in sources() if "zmq" in packages(parse(name))] == ["workers/channels.py"]


def test_one_file_starts_processes():
    assert [name for name in sources() if starts_processes(parse(name))] == ["workers/fork_server.py"]


@pytest.mark.parametrize("name", sources())
def test_nothing_is_unpickled(name):
    if name not in CONVERTERS:
        assert not unpickles(parse(name))


def test_the_bottom_stays_at_the_bottom():
    """Configuration, data, files and seeds know nothing of what is built on them."""
    for name, below in BOTTOM.items():
        own = (f"pipeline/{name}.py", f"pipeline/{name}/")
        for file in [each for each in sources() if each.startswith(own)]:
            ours = {each.split(".")[2] for each in imported(parse(file)) if each.startswith("oodil.")}
            assert ours <= {name, *below}, file
    for path in (ROOT / "pipeline" / "algorithms").rglob("*.py"):
        names = set(imported(parse(str(path.relative_to(ROOT)))))
        above = ("stage", "report", "training", "collecting", "environments", "evaluation")
        assert not {name for name in names if name.startswith(tuple(f"oodil.pipeline.{each}" for each in above))}, path


def loaded_at_import(tree: ast.Module) -> Iterator[str]:
    """Yield what a file imports when it is imported itself, not in functions and not for type checkers alone."""
    for node in tree.body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield from imported(ast.Module([node], []))


def room(module: str) -> str:
    """Return the file or folder of the pipeline, or the part of the program, that a module belongs to."""
    parts = module.removeprefix("oodil.").split(".")
    return ".".join(parts[:2]) if parts[0] == "pipeline" else parts[0]


def test_no_room_leads_back_to_itself():
    """Files and folders of the pipeline, workers, orchestrator and command line import each other in no circle."""
    arrows: dict[str, set[str]] = {}
    for name in sources():
        module = name.removeprefix("src/oodil/").removesuffix(".py").replace("/", ".").removesuffix(".__init__")
        targets = {room(each) for each in loaded_at_import(parse(name)) if each.startswith("oodil.")}
        arrows.setdefault(room(module), set()).update(targets - {room(module)})
    while True:
        free = [name for name, targets in arrows.items() if not targets & arrows.keys()]
        if not free:
            break
        for name in free:
            del arrows[name]
    assert not arrows, f"a circle among {sorted(arrows)}"


@pytest.mark.parametrize(
    ("file", "text", "check"),
    [
        ("pipeline/a.py", "def f():\n    import oodil.workers.engine", forbidden_imports),
        ("pipeline/stages/a.py", "from oodil.orchestrator import execute", forbidden_imports),
        ("workers/a.py", "import oodil.orchestrator", forbidden_imports),
        ("examples/a.py", "from pipeline.data import Demonstrations", forbidden_imports),
        ("orchestrator.py", "from oodil.terminal import Display", forbidden_imports),
        ("a.py", "from multiprocessing import Process", starts_processes),
        ("a.py", "import concurrent.futures", starts_processes),
        ("a.py", "import os\nos.fork()", starts_processes),
        ("a.py", "from os import fork", starts_processes),
        ("a.py", "import os\nos.execv('a', [])", starts_processes),
        ("a.py", "import torch\ntorch.multiprocessing.spawn(f)", starts_processes),
        ("a.py", "import pickle", unpickles),
        ("a.py", "from cloudpickle import loads", unpickles),
        ("a.py", "import torch\ntorch.load('a')", unpickles),
        ("a.py", "from torch import load", unpickles),
        ("a.py", "import yaml\nyaml.load('a', yaml.Loader)", unpickles),
        ("a.py", "import numpy\nnumpy.load('a', allow_pickle=True)", unpickles),
        ("a.py", "import numpy\nnumpy.load('a', allow_pickle=trust)", unpickles),
        ("a.py", "socket.recv_pyobj()", unpickles),
    ],
)
def test_the_checks_notice(file, text, check):
    tree = ast.parse(text)
    assert check(file, tree) if check is forbidden_imports else check(tree)


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("workers/a.py", "from oodil.pipeline.collecting import collect"),
        ("workers/a.py", "import os\nos.getpid()"),
        ("pipeline/a.py", "import numpy as np\nnp.load('a', allow_pickle=False)"),
        ("pipeline/a.py", "import yaml\nyaml.safe_load('a')"),
    ],
)
def test_the_checks_let_pass(file, text):
    tree = ast.parse(text)
    assert not forbidden_imports(file, tree)
    assert not starts_processes(tree)
    assert not unpickles(tree)


def loaded_by(module: str) -> set[str]:
    """Return the packages that importing a module loads in a fresh interpreter."""
    probe = f"import sys, {module}; print(*{{name.split('.')[0] for name in sys.modules}})"
    result = subprocess.run([sys.executable, "-c", probe], check=True, cwd=ROOT, capture_output=True, text=True)
    return set(result.stdout.split())


def test_algorithms_load_no_simulator():
    """Arrays in, arrays out: whatever collects, the algorithms need neither MuJoCo nor Gymnasium."""
    names = sorted(path.stem for path in (ROOT / "pipeline" / "algorithms").glob("*.py") if path.stem != "__init__")
    assert {"learner", "gail", "clustering"} <= set(names)
    loaded = loaded_by(", ".join(f"oodil.pipeline.algorithms.{name}" for name in names))
    assert "torch" in loaded
    assert not loaded & {"mujoco", "gymnasium", "highway_env", "robosuite"}


@pytest.mark.parametrize(
    "module",
    ["oodil.pipeline.collecting", "oodil.workers.rollout_worker", "oodil.pipeline.stages", "oodil.orchestrator"],
)
def test_rollout_workers_and_the_orchestrator_start_without_torch(module):
    loaded = loaded_by(module)
    assert "mujoco" in loaded
    assert not loaded & {"torch", "sklearn", "matplotlib"}
