"""Where the rover stood: `.rvf` of the rover motion counter's frames, XML.

Source: the writers and readers of these files in VICAR. Offset and quaternion take the rover frame to the
site frame, both z down.
"""

from pathlib import Path
from xml.sax.saxutils import quoteattr

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import wxyz_from_rotation
from pancam_graph.io.vicar import ReferenceFrame
from pancam_graph.results.formats._source import Source
from pancam_graph.results.formats._vicar import site_frame
from pancam_graph.rigs import pose_z_up

__all__ = ["write_rvf"]

_SOLUTION = "pancam_graph"


def write_rvf(source: Source, path: Path) -> None:
    """Write a `.rvf`: the pose of the rover at each stop in its site.

    Raises InputError for a rig that does not know where it is on the rover.
    """
    solution = source.solution
    mounted = solution.rig.rover_T_mast
    if mounted is None:
        raise InputError(
            "rvf: rig: expected a mast whose place on the rover is known (rover_T_mast), found none"
        )
    frame = site_frame(source)
    who = source.identities[0]
    lines = [
        '<?xml version="1.0" encoding="UTF-8" standalone="no"?>',
        f'<rmc_file mission={quoteattr(who.mission)} index1="{frame.index[0]}">',
        "  <priority>",
        f'    <entry solution_id="{_SOLUTION}"/>',
        "  </priority>",
    ]
    for stop, mast in enumerate(solution.final.world_T_mast):
        images = [i for i, s in enumerate(solution.traverse.image_stop.tolist()) if s == stop]
        place = source.identities[images[0]].place if images else (frame.index[0], stop)
        pose = pose_z_up(mast * mounted.inverse())  # its own inverse
        s, v1, v2, v3 = wxyz_from_rotation(pose.rotation().matrix()).tolist()
        x, y, z = pose.translation().tolist()
        rover = ReferenceFrame(name="ROVER_FRAME", index=place).attributes()
        lines += [
            f'  <solution solution_id="{_SOLUTION}"{rover}>',
            f"    <reference_frame{frame.attributes()}/>",
            f'    <offset x="{x!r}" y="{y!r}" z="{z!r}"/>',
            f'    <orientation s="{s!r}" v1="{v1!r}" v2="{v2!r}" v3="{v3!r}"/>',
            "  </solution>",
        ]
    path.write_text("\n".join([*lines, "</rmc_file>", ""]), encoding="utf-8", newline="\n")
