"""Third-party FMUs of FMI 3.0: run, shown, swept and published like those of this project."""

from __future__ import annotations

import re
import subprocess
import zipfile
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from native_models import HERE
from tools import needs

import twodof
from twodof.cli.main import main

DESCRIPTION = """\
<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="Oscillators" instantiationToken="theirs">
  <CoSimulation modelIdentifier="oscillators" hasEventMode="true" providesIntermediateUpdate="true"
    canReturnEarlyAfterIntermediateUpdate="true"/>
  <ModelVariables>
    <Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>
    <UInt64 name="n" valueReference="1" causality="structuralParameter" variability="fixed"
      start="2"/>
    <Float64 name="q" valueReference="2" causality="output" initial="calculated">
      <Dimension valueReference="1"/></Float64>
    <Float64 name="v" valueReference="3" causality="output" initial="calculated">
      <Dimension valueReference="1"/></Float64>
    <Float64 name="f" valueReference="4" causality="input" start="0">
      <Dimension valueReference="1"/></Float64>
    <Float64 name="w2" valueReference="5" causality="parameter" variability="fixed" start="4 9">
      <Dimension start="2"/></Float64>
    <Float64 name="end" valueReference="6" causality="parameter" variability="fixed" start="1e9"/>
    <Int32 name="turns" valueReference="7" causality="output" variability="discrete"/>
    <String name="label" valueReference="8" causality="parameter" variability="fixed">
      <Start value="theirs"/></String>
  </ModelVariables>
  <ModelStructure><Output valueReference="2"/><Output valueReference="3"/>
    <Output valueReference="7"/><InitialUnknown valueReference="2"/>
    <InitialUnknown valueReference="3"/><InitialUnknown valueReference="7"/></ModelStructure>
</fmiModelDescription>
"""


@pytest.fixture(scope="module")
def oscillators(tmp_path_factory):
    """Two oscillators q'' = −w2 q + f, from q = (1, 0.5)."""
    folder = tmp_path_factory.mktemp("oscillators")
    headers = Path(fmpy.__file__).parent / "c-code"
    source = (HERE / "oscillators.c").read_text()
    names = re.findall(r"TYPE +(fmi3\w+);", (headers / "fmi3Functions.h").read_text())
    others = [name for name in names if name not in source]
    rest = folder / "rest.c"
    rest.write_text("".join(f"int {name}(void) {{ return 0; }}\n" for name in others))
    library = folder / "oscillators.so"
    command = [needs("gcc"), "-shared", "-fPIC", "-I", headers, "-o", library]
    subprocess.run([*command, HERE / "oscillators.c", rest, "-lm"], check=True)
    fmu = folder / "Oscillators.fmu"
    with zipfile.ZipFile(fmu, "w") as archive:
        archive.writestr("modelDescription.xml", DESCRIPTION)
        archive.write(library, f"binaries/{fmpy.platform_tuple}/oscillators.so")
    return fmu


def position(t, start=(1.0, 0.5), w2=(4.0, 9.0), f=(0.0, 0.0)):
    """The closed form, from rest."""
    rest = np.divide(f, w2)
    return rest + (np.array(start) - rest) * np.cos(np.sqrt(w2) * t)


def test_it_is_one(oscillators):
    assert validate_fmu(str(oscillators)) == []


def test_samples_are_the_closed_form(oscillators):
    settings = {"f": [2.0, -1.0], "w2[2]": 16.0}
    for sample in twodof.samples(oscillators, stop_time=2.0, step=0.05, settings=settings):
        expected = position(sample.t, w2=(4.0, 16.0), f=(2.0, -1.0))
        np.testing.assert_allclose(sample.q, expected, rtol=0.0, atol=1e-13)
        assert sample.inputs == {"f[1]": 2.0, "f[2]": -1.0}


def test_one_element_changes_and_the_others_stay(oscillators):
    run = twodof.samples(oscillators, stop_time=1.0, step=0.1, settings={"f": 1.0})
    next(run)
    sample = run.send({"f[2]": 3.0})
    np.testing.assert_allclose(sample.q, position(0.1, f=(1.0, 3.0)), rtol=0.0, atol=1e-14)
    run.close()


def test_a_run_that_it_ends_fails_with_every_sample_so_far(oscillators, tmp_path, capsys):
    command = ["run", str(oscillators), "-o", str(tmp_path / "bag"), "--stop-time", "1"]
    assert main([*command, "--set", "end=0.5"]) == 1
    assert "the FMU ends the run" in capsys.readouterr().err
    assert twodof.read_bag(tmp_path / "bag").t[-1] == pytest.approx(0.5)


def test_a_sweep_over_a_vector(oscillators):
    table = twodof.sweep(oscillators, grid={"w2": [1.0, 2.0, 3.0]}, stop_time=1.0, workers=1)
    t = np.arange(101) * 0.01
    peaks = [np.max(np.sqrt(w2) * np.abs(np.sin(np.sqrt(w2) * t))) for w2 in (1.0, 2.0, 3.0)]
    np.testing.assert_allclose(table["peak_velocity"].to_numpy(), peaks, rtol=1e-12)


def test_its_bag_and_the_printed_facts(oscillators, tmp_path, capsys):
    bag = twodof.Bag(tmp_path / "bag")
    twodof.simulate(oscillators, bag, stop_time=1.0)
    recording = twodof.read_bag(tmp_path / "bag")
    expected = [position(t) for t in recording.t]
    np.testing.assert_allclose(recording.q, expected, rtol=0.0, atol=1e-13)
    assert main(["info", str(oscillators)]) == 0
    said = capsys.readouterr().out
    assert re.search(r"FMU .*fmu \(Oscillators\)\n", said) and re.search(r"FMI +3\.0\n", said)
    assert re.search(r"w2\[2\] +4, 9 +parameter\n", said)
    for refused, reason in (
        (["page", str(oscillators), "-o", str(tmp_path / "a.html")], "is not a native FMU of twodof"),
        (["linearise", str(oscillators)], "has no directional derivatives"),
        (["live", str(oscillators), "--no-browser"], "contains no robot"),
    ):
        assert main(refused) == 1
        message = capsys.readouterr().err
        assert reason in message and message.count("\n") == 1
