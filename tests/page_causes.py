"""The causes that the script of a page names for a run, and its balance of forces, computed by Node.js."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from scratch import run_folder
from tools import needs

import twodof
from twodof.pages.arm import RECORDED, arm_of, arm_page

ROOT = Path(__file__).parents[1]


def page_causes(run: twodof.Experiment, samples: Sequence[twodof.Sample], call: str = "", *arguments: object) -> Any:
    """Return the page's causes after all samples of a run, the root first, or what a method of its balance returns."""
    scripts = run_folder() / "page-scripts"
    if not scripts.exists():
        shutil.copytree(ROOT / "fmu_src/page", scripts)
        (scripts / "package.json").write_text('{"type": "module"}')
    page = arm_page("", arm_of(run), {}).decode()
    found = re.search(r'id="arm-facts">(.*?)</script>', page)
    assert found is not None
    targets = {name: run.fmu.vector(name) for name in RECORDED if name.endswith("_des")}
    rows = [
        [s.t, *(v for g in RECORDED for v in (map(s.inputs.get, targets[g]) if g in targets else getattr(s, g)))]
        for s in samples
    ]
    inputs = [samples[0].inputs, *(sample.inputs for sample in samples)]
    changes = [{} if new is old else new for old, new in pairwise(inputs)]
    changes[0] = {**run.start_values, **inputs[0]}
    asked = {"call": call, "arguments": arguments} if call else None
    text = json.dumps({"facts": json.loads(found[1]), "rows": rows, "changes": changes, "asked": asked})
    command = [needs("node"), str(ROOT / "tests/page_causes.mjs"), scripts.as_uri()]
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)
