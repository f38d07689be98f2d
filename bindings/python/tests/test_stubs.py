"""The types of the package, and the stubs of the extension module beside the module itself."""

from __future__ import annotations

import importlib.util
import pathlib
import subprocess
import sys

import pytest

import sinew

pytestmark = pytest.mark.skipif(importlib.util.find_spec("mypy") is None, reason="there is no mypy")

PROGRAM = """
import sinew
from typing import Optional

@sinew.payload("stub.angle")
class Angle:
    degrees: float

async def main() -> None:
    async with sinew.register("x") as me:
        outcome: sinew.Outcome = await me.send_confirmed("knee", Angle(degrees=1.0))
        message: sinew.Message = await me.receive()
        later: Optional[sinew.Message] = await me.receive(1.0)
    with sinew.register("x") as blocking:
        tid: Optional[sinew.Tid] = blocking.resolve("knee")
        reveal_type(blocking.parameters("knee")["kp"].value)
    Angle("no number")
"""


def test_package_has_types(tmp_path: pathlib.Path) -> None:
    assert (pathlib.Path(sinew.__file__).parent / "py.typed").exists()
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    command = [sys.executable, "-m", "mypy", "--strict", str(program)]
    checked = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    lines = [line for line in checked.stdout.splitlines() if "error" in line]
    assert len(lines) == 2 and 'to "Angle" has incompatible type' in lines[0], checked.stdout + checked.stderr
    assert "Union[float, int, bool]" in checked.stdout or "float | int | bool" in checked.stdout, checked.stdout


def test_stubs_are_those_of_the_module(tmp_path: pathlib.Path) -> None:
    settings = pathlib.Path(__file__).parents[1] / "pyproject.toml"
    command = [sys.executable, "-m", "mypy.stubtest", "--mypy-config-file", str(settings), "sinew"]
    tested = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert tested.returncode == 0, tested.stdout + tested.stderr
