"""How far terrain is from the truth of rendered drives, and what refining gains.

    python scripts/terrain_accuracy.py --rig mer-navcam --seeds 8101 8102

Each drive is two stops 5 m apart. It is rendered, refined from its pictures and made into terrain by the
program itself, as a user would; the table has errors against the rendering's truth, and what the runs took.
"""

import sys
from dataclasses import asdict
from json import dumps
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.terrain import measure_terrain, table
from pancam_graph.cli import ScriptParser, run


def main() -> int:
    """Parse options, measure, print."""
    parser = ScriptParser(__doc__ or "")
    add = parser.add_argument
    add("--rig", default="mer-navcam", help="template of the cameras (%(default)s)")
    add("--seeds", type=int, nargs="+", default=[0], help="another seed, another world (0)")
    add("--pans", type=int, default=10, help="frames a stop (%(default)s)")
    add(
        "--rig-error",
        choices=("none", "drawn"),
        default="none",
        help="drawn: the rig that is told is off as its uncertainty says (%(default)s)",
    )
    add("--folder", type=Path, help="where drives and results stay (nowhere)")
    add("--json", type=Path, help="file for all figures")
    arguments = parser.parse_args()
    found = []
    with TemporaryDirectory() as nowhere:
        folder = arguments.folder or Path(nowhere)
        for seed in arguments.seeds:
            print(f"{arguments.rig}, seed {seed}", file=sys.stderr)
            found.append(
                measure_terrain(
                    arguments.rig, seed, folder, pans=arguments.pans, rig_error=arguments.rig_error
                )
            )
    if arguments.json is not None:
        arguments.json.write_text(dumps([asdict(one) for one in found], indent=1))
    print(table(found))
    return 0


if __name__ == "__main__":
    run(main)
