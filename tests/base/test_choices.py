"""What is said of a name that there is not."""

from pancam_graph.base.choices import expected_one_of


def test_a_near_name_is_offered_and_long_lists_are_cut() -> None:
    names = [f"f{i}" for i in range(9)]
    assert expected_one_of("frame", "f11", names) == (
        "frame: expected one of f0, f1, f2, f3, f4, f5 and 3 more; found 'f11'; is 'f1' meant?"
    )
    assert expected_one_of("camera", "x", ["left", "right"]) == (
        "camera: expected one of left, right; found 'x'"
    )
