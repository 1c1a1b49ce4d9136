"""Mutated mesh files are drawn, or left out with one warning.

Case i is made by ``random.Random(i)``: ten mutations of one file of the corpus, in one robot.
"""

from __future__ import annotations

import resource
from pathlib import Path
from random import Random

import mutations
import numpy as np
import pytest

from twodof.bounds import MAX_FATAL_MESHES, MAX_MESH_MEMORY, MAX_MESH_SECONDS
from twodof.geometry.meshes import Meshes

pytestmark = pytest.mark.long

CORPUS = sorted(path for path in (Path(__file__).parent / "corpus").iterdir() if path.is_file())
BROKEN = sorted((Path(__file__).parent / "corpus" / "broken").iterdir())
"""Each ended the process that read it, or took gigabytes or minutes."""
CASES, ALL_CASES, BATCH = 2, 1000, 10
KINDS = {".dae": mutations.xml, ".obj": mutations.text, ".off": mutations.text}


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Generate all cases with --full."""
    if "seed" in metafunc.fixturenames:
        full = metafunc.config.getoption("full")
        metafunc.parametrize("seed", range(ALL_CASES if full else CASES))


@pytest.mark.parametrize("file", CORPUS, ids=lambda file: file.name)
def test_mesh_of_the_corpus_is_read(file: Path, caplog: pytest.LogCaptureFixture) -> None:
    with Meshes({file.name: file.read_bytes()}.get) as meshes:
        parts = meshes.scaled(file.name, np.ones(3))
    assert sum(len(part.triangles) for part in parts) == (8 if file.suffix == ".dae" else 4)
    assert not caplog.records


@pytest.mark.parametrize("file", BROKEN, ids=lambda file: file.name)
def test_mesh_that_broke_its_reader_is_left_out(file: Path, caplog: pytest.LogCaptureFixture) -> None:
    with Meshes({file.name: file.read_bytes()}.get) as meshes:
        assert meshes.scaled(file.name, np.ones(3)) == []
    (record,) = caplog.records
    assert record.getMessage().startswith(f"mesh '{file.name}' is left out: it ")


@pytest.mark.parametrize("file", CORPUS, ids=lambda file: file.name)
def test_mutated_mesh(file: Path, seed: int, caplog: pytest.LogCaptureFixture) -> None:
    rng = Random(seed)
    kinds = (mutations.blind, KINDS.get(file.suffix, mutations.text))
    data = file.read_bytes()
    files = {f"{i}{file.suffix}": rng.choice(kinds)(rng, data) for i in range(BATCH)}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    drawn = {}
    with Meshes(files.get) as meshes:
        for name in files:
            drawn[name] = meshes.scaled(name, np.ones(3))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    for parts in drawn.values():
        for part in parts:
            assert np.isfinite(part.vertices).all()
            assert part.triangles.max() < len(part.vertices)
    texts = [record.getMessage() for record in caplog.records]
    left_out = [name for name, parts in drawn.items() if not parts]
    assert [text.partition("' is left out: ")[0] for text in texts] == [f"mesh '{name}" for name in left_out]
    assert all("\n" not in text and len(text) < 600 for text in texts)
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # the peak of a child includes that of its parent
    assert after.ru_maxrss * 1024 < max(MAX_MESH_MEMORY, max(before.ru_maxrss, own) * 1024 + 1)
    starts = 2 * MAX_FATAL_MESHES + 2
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    assert seconds < MAX_FATAL_MESHES * (MAX_MESH_SECONDS + 1) + 1.5 * starts
