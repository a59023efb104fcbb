"""Source distribution and wheel: complete, accepted by the index, and the wheel alone scores an archive."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import rebar_depth_bench as rdb
from tests.building import TINY_DATASET
from tests.requirements import pip_environment, require_index

ROOT = Path(__file__).parents[2]
PACKAGES = {"cards", "dataset_builder", "leaderboard", "rebar_depth_bench"}
REQUIREMENTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
MAX_BYTES = {"sdist": 22_000_000, "wheel": 12_000_000}

pytestmark = pytest.mark.slow


def run(
    *command: str | Path, cwd: Path, status: int = 0, variables: Mapping[str, str] = {}
) -> subprocess.CompletedProcess[str]:
    environment = {**pip_environment(), **variables}
    finished = subprocess.run(
        list(map(str, command)), cwd=cwd, capture_output=True, text=True, env=environment, check=False
    )
    assert finished.returncode == status, f"{finished.stdout}\n{finished.stderr}"
    return finished


@pytest.fixture(scope="module")
def source_files() -> set[str]:
    """Return the files that git knows, relative to its root."""
    if not (ROOT / ".git").exists():
        pytest.skip("the source is no git repository")
    listed = run("git", "ls-files", "-z", cwd=ROOT).stdout
    return {name for name in listed.split("\0") if (ROOT / name).is_file()}


@pytest.fixture(scope="module")
def distributions(source_files: set[str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Build both distributions from a copy of the source: setuptools reads what earlier builds left behind."""
    pytest.importorskip("build")
    folder = tmp_path_factory.mktemp("packaging")
    require_index(folder / "downloads")
    for name in source_files:
        (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, folder / "source" / name)
    run(sys.executable, "-m", "build", "--outdir", folder / "dist", cwd=folder / "source")
    (sdist,) = folder.glob("dist/*.tar.gz")
    (wheel,) = folder.glob("dist/*.whl")
    return {"sdist": sdist, "wheel": wheel}


@pytest.fixture(scope="module")
def installed(distributions: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the wheel with its base dependencies only, in the lowest versions; return the folder of programs."""
    folder = tmp_path_factory.mktemp("installed")
    run(sys.executable, "-m", "venv", folder / "venv", cwd=folder)
    pip, constraints = folder / "venv" / "bin" / "pip", folder / "lowest.txt"
    constraints.write_text(run(sys.executable, ROOT / "scripts" / "lowest_versions.py", cwd=folder).stdout)
    run(pip, "install", "--quiet", "--constraint", constraints, distributions["wheel"], cwd=folder)
    return folder / "venv" / "bin"


def names_in_wheel(wheel: Path) -> Iterator[str]:
    with zipfile.ZipFile(wheel) as archive:
        yield from (name for name in archive.namelist() if ".dist-info/" not in name)


def test_distributions_are_small_and_pass_the_check_of_the_index(distributions: dict[str, Path]) -> None:
    pytest.importorskip("twine")
    checked = run(sys.executable, "-m", "twine", "check", "--strict", *distributions.values(), cwd=ROOT).stdout
    assert checked.count("PASSED") == 2
    assert all(path.stat().st_size < MAX_BYTES[kind] for kind, path in distributions.items())


def test_distributions_hold_every_file_and_no_other(
    distributions: dict[str, Path], source_files: set[str]
) -> None:
    expected = {name for name in source_files if name.split("/")[0] in PACKAGES}
    assert set(names_in_wheel(distributions["wheel"])) == expected
    with tarfile.open(distributions["sdist"]) as archive:
        names = {member.name.partition("/")[2] for member in archive if member.isfile()}
    generated = {name for name in names if name.startswith("rebar_depth_bench.egg-info/")}
    assert names - generated - {"PKG-INFO", "setup.cfg"} == source_files


def test_wheel_alone_scores_as_the_source(
    installed: Path, tiny_truth: dict[str, np.ndarray], archive_of: Callable[..., Path], tmp_path: Path
) -> None:
    rng = np.random.default_rng(3)
    archive = archive_of({name: 1.1 * z_m * rng.normal(1, 0.01, z_m.shape) for name, z_m in tiny_truth.items()})
    printed = run(
        installed / "rebar-bench", "score", archive, "--data", TINY_DATASET, "--json", "-", cwd=tmp_path
    ).stdout
    result = json.loads(printed)
    assert result["tables"]["lattice"]["views"] == len(tiny_truth)
    assert result["tables"]["lattice"]["scale_median"] == pytest.approx(1 / 1.1, rel=0.01)
    assert result == json.loads(rdb.score(archive, TINY_DATASET).to_json())


def test_lowest_versions_are_installed_and_fit_together(installed: Path, tmp_path: Path) -> None:
    listed = json.loads(run(installed / "pip", "list", "--format", "json", cwd=tmp_path).stdout)
    found = {canonicalize_name(package["name"]): Version(package["version"]) for package in listed}
    for requirement in map(Requirement, REQUIREMENTS):
        [lowest] = [bound.version for bound in requirement.specifier if bound.operator == ">="]
        assert found[canonicalize_name(requirement.name)] == Version(lowest)
    run(installed / "pip", "check", cwd=tmp_path)


def test_lowest_versions_load_matrices_as_float64(installed: Path, tmp_path: Path) -> None:
    code = (
        "import sys, numpy as np, rebar_depth_bench as rdb\n"
        "row = rdb.load(sys.argv[1], 'lattice')[0]\n"
        "print(np.linalg.inv(row['left_K'])[0, 0], row['left_cam_from_world'].dtype)\n"
        "print(row['left_depth'].sum(dtype=float))"
    )
    row = rdb.load(TINY_DATASET, "lattice")[0]
    printed = run(installed / "python", "-c", code, TINY_DATASET, cwd=tmp_path).stdout.split()
    assert printed[1] == "float64"
    expected = [1 / row["left_K"][0, 0], row["left_depth"].sum(dtype=float)]
    np.testing.assert_allclose([float(printed[0]), float(printed[2])], expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("packages", "words"),
    [
        (("pillow==11.3.0",), "Pillow 11.3.0 lacks TIFF with Zstandard, expected"),
        (
            ("datasets==5.0.1", "requests", "urllib3", "charset-normalizer"),
            "datasets 5.0.1 is installed, expected 5.1 or later",
        ),
    ],
)
def test_version_below_the_bounds_is_named_and_no_data_are_called_damaged(
    packages: tuple[str, ...], words: str, installed: Path, tmp_path: Path
) -> None:
    """An environment may hold older versions than pip allows, as after the installation of another program."""
    old = tmp_path / "old"
    run(installed / "pip", "install", "--quiet", "--no-deps", "--target", old, *packages, cwd=tmp_path)
    code = "import sys, rebar_depth_bench as rdb; rdb.load(sys.argv[1], 'lattice')[0]['left_depth']"
    variables = {"PYTHONPATH": str(old)}
    refused = run(
        installed / "python", "-c", code, TINY_DATASET, cwd=tmp_path, status=1, variables=variables
    ).stderr.splitlines()[-1]
    assert words in refused
    assert "damaged" not in refused


def test_wheel_alone_exports(installed: Path, tmp_path: Path) -> None:
    run(installed / "rebar-build", "export", TINY_DATASET, "--out", "plain", "--config", "lattice", cwd=tmp_path)
    assert len(list(tmp_path.glob("plain/lattice/**/*.png"))) > 9


@pytest.mark.parametrize(
    ("command", "extra"),
    [
        (("rebar-build", "--out", "dataset"), "build"),
        (("rebar-build", "inspect", str(ROOT / "examples" / "beam.toml")), "build"),
        (("rebar-leaderboard", "serve", "--data", str(TINY_DATASET)), "server"),
        (("rebar-bench", "demo"), "build"),
        (("rebar-bench", "demo", "--sample"), "methods"),
        (("rebar-bench", "predict", "sgbm", "--data", str(TINY_DATASET), "--out", "a.zip"), "methods"),
    ],
    ids=lambda value: " ".join(value[:2]) if isinstance(value, tuple) else None,
)
def test_missing_extra_is_named(installed: Path, command: tuple[str, ...], extra: str, tmp_path: Path) -> None:
    program, *arguments = command
    finished = run(installed / program, *arguments, cwd=tmp_path, status=2)
    assert f"pip install '.[{extra}]'" in finished.stderr
    assert extra != "build" or finished.stderr.startswith("error: not installed: bpy")
    assert "Traceback" not in finished.stderr
    assert not list(tmp_path.iterdir())
