"""The examples, run as their readers run them, against a live server and a drawn town."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from conftest import ROOT
from live_server import Server
from placeformer import Client

EXAMPLES = ROOT / "examples"


@pytest.fixture(scope="session")
def town(program: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small drawn town, in the folders `database` and `queries`."""
    town = tmp_path_factory.mktemp("drawn") / "town"
    command = [str(program), "synth", "--out", str(town), "--places", "3", "--views", "2"]
    command += ["--size", "224x168", "--conditions", "day"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return town


def run(command: list[str]) -> str:
    """Run a command and return what it prints."""
    outcome = subprocess.run(command, capture_output=True, text=True, check=False)
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr
    return outcome.stdout


def test_curl(server: Server, town: Path) -> None:
    photo = str(sorted((town / "database").iterdir())[0])
    output = run([str(EXAMPLES / "curl.sh"), server.url, photo, photo])
    assert '"status":"ready"' in output
    assert '"external_id":"the-photo"' in output
    assert '"spatial_score"' in output
    assert '"references_deleted":1' in output


def test_vehicle(server: Server, town: Path, map_name: str) -> None:
    names = sorted(path.name for path in (town / "database").iterdir())
    with Client(server.url) as client:
        for name in names:
            client.add_reference(
                town / "database" / name, map_name, external_id=name, lat=51.0, lon=7.0
            )
    vehicle = [sys.executable, str(EXAMPLES / "vehicle.py"), "--server", server.url]
    # The mapped photos themselves, so slowly that each is answered.
    drive = ["--map", map_name, "--frames", str(town / "database")]
    output = run([*vehicle, *drive, "--rate", "0.8", "--deadline-ms", "60000"])
    assert f"{len(names)} frames: " in output
    assert "at 51.000000, 7.000000" in output
    # Far faster than anything is answered: frames are dropped, and the drive goes on.
    output = run([*vehicle, *drive, "--rate", "1000", "--deadline-ms", "60000"])
    assert f"{len(names) - 1} dropped" in output
    # What no later frame would change ends the drive.
    wrong = ["--map", "no-such-map", "--frames", str(town / "database"), "--rate", "5"]
    outcome = subprocess.run([*vehicle, *wrong], capture_output=True, text=True, check=False)
    assert outcome.returncode == 1
    assert "map_not_found" in outcome.stderr


def test_notebook(server: Server, town: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook = nbformat.read(EXAMPLES / "map_and_query.ipynb", as_version=4)  # type: ignore[no-untyped-call]
    nbformat.validate(notebook)
    assert not any(cell.get("outputs") for cell in notebook.cells), "it is kept without outputs"
    monkeypatch.setenv("PLACEFORMER_SERVER", server.url)
    monkeypatch.setenv("TOWN", str(town))
    monkeypatch.setenv("JUPYTER_PLATFORM_DIRS", "1")
    NotebookClient(notebook, timeout=300, kernel_name="python3").execute(env=dict(os.environ))
    printed = "".join(
        output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", [])
    )
    assert "6 photos, 0 refused\nthe map has 6" in printed
    assert "inliers: " in printed
    pictures = [
        output
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        if "image/png" in output.get("data", {})
    ]
    assert len(pictures) == 2
