"""What a user writes passes a strict type check."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

MORE = """
from sb3_combrel import compare, explain

found = explain(model, "explained")
print(found.mappings[0].compliance, model.transfer.report())
by_name = InterTaskMapping(state={"x": "x"}, action={"East": "Right"}, sign={"x": -1})
result = compare("combrel/MountainCar4D-v0", {"none": None, "COMBREL": COMBREL("source.npz")}, seeds=[1, 2], steps=100)
print(result.sentence, result.table)
result.figure().savefig("curves.png")
"""


@pytest.mark.long
def test_the_lines_of_the_readme_and_the_results_pass_mypy_strict(tmp_path):
    pytest.importorskip("mypy")
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    file = tmp_path / "users_code.py"
    file.write_text("\n".join([*blocks, "from sb3_combrel import COMBREL, InterTaskMapping\n", MORE]))
    # Only what a user writes is judged, against the types that this package declares.
    options = ["--strict", "--follow-imports=silent", "--config-file=", f"--cache-dir={os.devnull}"]
    with_package = {**os.environ, "MYPYPATH": f"{ROOT}:{ROOT / 'envs'}"}
    command = [sys.executable, "-m", "mypy", *options, str(file)]
    done = subprocess.run(command, cwd=tmp_path, env=with_package, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
