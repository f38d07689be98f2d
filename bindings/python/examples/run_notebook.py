"""Runs the notebook `walk.ipynb` and writes its pictures: `python run_notebook.py WALK.mcap FOLDER`.

It needs nbclient, ipykernel, pandas and matplotlib, and the socket of the walking leg in $SINEW_SOCKET.
"""

import base64
import os
import pathlib
import sys

import nbclient
import nbformat

WITHIN = 300
"""Seconds for one cell."""


def main(walk: str, folder: pathlib.Path) -> None:
    os.environ["WALK"] = os.path.abspath(walk)
    notebook = nbformat.read(pathlib.Path(__file__).with_name("walk.ipynb"), as_version=4)
    nbclient.NotebookClient(notebook, timeout=WITHIN).execute()
    folder.mkdir(parents=True, exist_ok=True)
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    pictures = [output.data["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    for number, picture in enumerate(pictures, 1):
        path = folder / f"walk-{number}.png"
        path.write_bytes(base64.b64decode(picture))
        print(path)


if len(sys.argv) != 3:
    sys.exit(__doc__)
main(sys.argv[1], pathlib.Path(sys.argv[2]))
