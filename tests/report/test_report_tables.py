"""Tables of the page: images, observations, what was thrown away and why, what of the rig was free."""

import re
from dataclasses import replace
from html import unescape
from typing import Any

import numpy as np
import pytest

from pancam_graph.cli._summary import print_summary
from pancam_graph.data import Matching, PairMatching, Refined, Refusal, Solution, StopMatching
from pancam_graph.report._images import image_residuals
from pancam_graph.report._page import make_page
from pancam_graph.report._tables import observation_table
from support.report_pages import parsed


def test_image_table_counts_what_the_solution_says(solution: Solution, page: str) -> None:
    table, rows = image_residuals(solution)
    assert sum(e.used for e in table) == solution.used.sum()
    assert sum(e.rejected for e in table) == np.sum(~solution.used)
    observations = solution.traverse.observations
    assert observations is not None
    assert all(np.all(observations.image[r] == i) for i, r in enumerate(rows))
    total = sum(e.used * e.after_px**2 for e in table) / solution.used.sum()
    assert np.sqrt(total) == pytest.approx(solution.rms_final_px)
    assert page.count("<tr><td") == len(solution.traverse.images) + len(solution.traverse.stops) + 3


def test_observation_table_counts_by_reason(solution: Solution) -> None:
    observations = solution.traverse.observations
    assert observations is not None
    cells = [
        re.findall(r"<td[^>]*>([^<]*)</td>", row) for row in observation_table(solution).split("<tr>")[2:]
    ]
    assert [row[0] for row in cells] == ["one stop", "several stops", "all"]
    numbers = np.array([[int(c) for c in (*row[1:4], *row[5:9])] for row in cells])
    assert (numbers[0] + numbers[1] == numbers[2]).all()
    assert (numbers[:2, :3] > 0).all()
    kinds = ("outlier", "single", "behind", "outside")
    expected = [len(observations), solution.used.sum(), *(solution.reason.count(kind) for kind in kinds)]
    assert numbers[2, 1:].tolist() == expected
    assert (numbers[:, 1] == numbers[:, 2:].sum(axis=1)).all()
    assert [float(row[4]) for row in cells] == pytest.approx(100 * numbers[:, 2] / numbers[:, 1], abs=0.06)


def matched(solution: Solution) -> Solution:
    """The same, as if its observations came from images."""
    pairs = (
        PairMatching(a=0, b=1, candidates=120, rover=0, off_line=20, kept=100),
        PairMatching(a=0, b=2, candidates=50, rover=7, off_line=3, kept=40),
        PairMatching(a=1, b=2, candidates=9, rover=0, off_line=0, kept=0, refusal=Refusal.FEW_ALIKE),
        PairMatching(a=1, b=3, candidates=90, rover=0, off_line=0, kept=0, refusal=Refusal.CHANCE),
    )
    counts: dict[str, Any] = {
        "sought": 300,
        "unlike": 40,
        "ambiguous": 30,
        "unstable": 20,
        "masked": 5,
        "off_pose": 10,
    }
    nothing = dict.fromkeys(counts, 0)
    stops = (
        StopMatching(a=0, b=1, **counts, kept=195, noise_px=0.1234),
        StopMatching(a=1, b=0, **nothing, kept=0, noise_px=0.0, refusal=Refusal.CHANCE),
    )
    traverse = replace(solution.traverse, matching=Matching(pairs=pairs, stops=stops))
    came_back = np.zeros(len(solution.used), dtype=bool)
    came_back[np.flatnonzero(solution.used)[:3]] = True
    return replace(solution, traverse=traverse, came_back=came_back)


def test_page_says_what_was_thrown_away_and_why(solution: Solution, page: str) -> None:
    assert "<h2>Matching</h2>" not in page
    found = make_page(matched(solution))
    parsed(found)
    section = found[found.index("<h2>Matching</h2>") :]
    section = section[: section.index("</section>")]
    lines = [unescape(line) for line in re.findall("<li>(.*?)</li>", section)]
    assert lines == [
        "pairs of images: 2 of 4 matched; 1 too few look alike, 1 no more agree than by chance",
        "their matches: 140 of 170 kept; 23 off their epipolar lines, 7 standing still relative to the mast",
        "patches between stops: 195 of 300 kept; 40 unlike, 30 ambiguous, 20 unstable, 5 masked, "
        "10 off the common pose",
    ]
    rows = [re.findall("<td[^>]*>(.*?)</td>", row) for row in re.findall("<tr>(.*?)</tr>", section)]
    stops = [s.id for s in solution.traverse.stops]
    images = [i.id for i in solution.traverse.images]
    filled = [row for row in rows if row]
    assert filled[0] == [*stops[:2], "", "300", "195", "40", "30", "20", "5", "10", "0.123"]
    assert filled[1][:3] == [stops[1], stops[0], "no more agree than by chance"]
    assert filled[3] == [images[0], images[2], "", "50", "40", "3", "7"]
    assert filled[5] == [images[1], images[3], "no more agree than by chance", "90", "0", "0", "0"]
    table = observation_table(matched(solution))
    back = [re.findall("<td[^>]*>(.*?)</td>", row)[9] for row in re.findall("<tr>(<td.*?)</tr>", table)]
    assert back[2] == "3"
    assert int(back[0]) + int(back[1]) == 3


def test_program_prints_what_was_thrown_away_and_why(
    solution: Solution, capsys: pytest.CaptureFixture[str]
) -> None:
    print_summary(solution, "out")
    assert len(capsys.readouterr().out.splitlines()) == 1
    print_summary(matched(solution), "out")
    lines = capsys.readouterr().out.splitlines()
    matching = matched(solution).traverse.matching
    assert matching is not None
    assert lines[1:4] == list(matching.summary())
    left_out = int(np.sum(~solution.used))
    assert lines[4].startswith(f"in the solve: {left_out} of {len(solution.used)} observations left out")
    assert lines[4].endswith("3 of those used came back after they had been set aside")


def test_rig_table_says_what_was_free(solution: Solution, page: str) -> None:
    head = "What the pictures say of the camera"
    assert head not in page
    common: dict[str, Any] = {"stop": None, "image": None, "sigma": 1e-3, "prior_sigma": np.inf}
    entries = (
        Refined(quantity="calibration", entry="focal", camera="left", nominal=1.0, change=2e-3, **common),
        Refined(quantity="mounts", entry="rx_rad", camera="<left>", nominal=0.0, change=0.1, **common),
        Refined(
            quantity="radius",
            entry="radius_m",
            camera="right",
            stop="s1",
            image="im1",
            nominal=0.25,
            change=-2e-3,
            sigma=np.nan,
            prior_sigma=5e-3,
        ),
        Refined(quantity="calibration", entry="cx_px", camera=None, nominal=None, change=1.5, **common),
    )
    page = make_page(replace(solution, refined=entries))
    text = parsed(page).text
    assert head in text
    rows = re.findall(r"<tr[^>]*>(.*?)</tr>", page[page.index(f"<h2>{head}</h2>") :])[1:5]
    found = [[unescape(cell) for cell in re.findall(r"<td[^>]*>(.*?)</td>", row)] for row in rows]
    fx = solution.traverse.rig.pinholes[0].fx_px
    dash = "\N{EN DASH}"
    none = [dash, dash]
    assert found == [
        [
            "left lens",
            "focal length",
            "px",
            f"{fx:.3f}",
            "none",
            f"{1.002 * fx:.3f}",
            f"{1e-3 * fx:.3f}",
            *none,
        ],
        ["<left> mount", "turn about x", "mrad", "0.0000", "none", "100.0000", "1.0000", *none],
        [
            "im1 circle",
            "radius of its circle",
            "mm",
            "250.000",
            "5.000",
            "248.000",
            none[0],
            "-0.40",
            none[0],
        ],
        ["lens", "principal point u", "px", "differs", "none", "1.500", "0.001", *none],
    ]
